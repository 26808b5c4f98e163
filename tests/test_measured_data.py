"""Measured data of others: the list, where they are looked for, and fetching them without any network."""

import csv
import errno
import hashlib
import io
import json
import socket
import tarfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from grindvision.cli import main
from grindvision.data_files import PLACES, data_folder
from grindvision.errors import DataNotHereError, FileError, InputError, MissingExtraError
from grindvision.measured import absent_sets, find_measured, measured_set, measured_sets, missing_files
from grindvision.measured_fetch import fetch, over_http

CONTENT = {"made/one.csv": b"pose,x_mm\n1,2.5\n", "made/two.conf": b"mesh a.ply 0 0 1\nmesh b.ply 1 0 0\n"}
ALL_LINES = b"camera 1 2 3\nmesh a.ply 0 0 1\nmesh b.ply 1 0 0\nmesh c.ply 0 0 0\n"


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture
def server(tmp_path):
    """Folder that a server on this machine publishes, and its address."""
    folder = tmp_path / "published"
    folder.mkdir()
    (folder / "one.csv").write_bytes(CONTENT["made/one.csv"])
    with tarfile.open(folder / "two.tar.gz", "w:gz") as archive:
        info = tarfile.TarInfo("two/all.conf")
        info.size = len(ALL_LINES)
        archive.addfile(info, io.BytesIO(ALL_LINES))
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{running.server_address[1]}"
        running.shutdown()


@pytest.fixture
def listed(tmp_path, monkeypatch, server):
    """A list of two sets, one of which cannot be fetched; ``GRINDVISION_DATA`` names its folder, there is no cache."""
    folder = tmp_path / "data"
    (folder / "paper").mkdir(parents=True)
    names = ["name", "file", "instrument", "unit", "frame", "licence", "credit", "address", "size_bytes", "sha256"]
    told = ["a tracker", "mm", "base", "MIT", "nobody"]
    addresses = {"made/one.csv": "/one.csv", "made/two.conf": "/two.tar.gz!two/all.conf"}
    changes = {"made/one.csv": "", "made/two.conf": "lines with a.ply or b.ply"}
    with open(folder / "measured.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*names, "conversion", "truth"])
        for name, content in CONTENT.items():
            about = [server[1] + addresses[name], len(content), hashlib.sha256(content).hexdigest(), changes[name]]
            table.writerow(["made", name, *told, *about, "known"])
        table.writerow(["drawn", "drawn.ply", *told, server[1] + "/cad.stl", 1, "0" * 64, "points on it", "known"])
    monkeypatch.setenv("GRINDVISION_DATA", str(folder))
    monkeypatch.setattr("grindvision.measured.user_cache", lambda: None)
    return folder


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(capsys, *words: object) -> str:
    """The one line that a refused call prints."""
    assert main(["data", *map(str, words)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


# --- the list


def test_the_list_names_origin_licence_hash_and_truth_of_every_file():
    for wanted in measured_sets().values():
        assert all((wanted.instrument, wanted.unit, wanted.frame, wanted.licence, wanted.credit, wanted.truth))
        for file in wanted.files:
            assert file.address.startswith("https://") and file.size_bytes > 0 and len(file.sha256) == 64
            commit = file.address.split("/")[5] if "githubusercontent" in file.address else "0" * 40
            assert len(commit) == 40, "an address at a commit"
            assert not Path(file.file).is_absolute() and ".." not in Path(file.file).parts


def test_what_has_no_licence_is_not_listed():
    names = [file.file for wanted in measured_sets().values() for file in wanted.files]
    assert len(names) == len(set(names)) and not [name for name in names if "weld" in name]
    assert "" not in [wanted.licence for wanted in measured_sets().values()]


def test_the_real_files_are_those_that_are_listed(real_data):
    for wanted in measured_sets().values():
        folder = real_data(wanted.files[0].file).parents[len(Path(wanted.files[0].file).parts) - 1]
        assert missing_files(wanted, folder) == []
        assert [(folder / file.file).stat().st_size for file in wanted.files] == [f.size_bytes for f in wanted.files]


def test_rows_of_one_set_must_agree(listed):
    text = (listed / "measured.csv").read_text()
    (listed / "measured.csv").write_text(text.replace("MIT", "GPL", 1))
    with pytest.raises(FileError, match="the rows of made do not agree"):
        measured_sets()


# --- where they are looked for


def test_a_folder_of_measured_data_leaves_the_printed_ones_where_they_are(tmp_path, monkeypatch):
    monkeypatch.setenv("GRINDVISION_DATA", str(tmp_path))
    assert data_folder() in PLACES
    with pytest.raises(DataNotHereError, match=f"ur5 are not here.*{tmp_path}.*grindvision data ur5"):
        find_measured("ur5")


def test_an_absent_set_is_named_and_a_whole_one_found(listed):
    assert absent_sets(["made", "drawn"]) == ["made", "drawn"]
    fetch(measured_set("made"), listed)
    assert absent_sets(["made", "drawn"]) == ["drawn"] and find_measured("made") == listed


def test_a_file_that_was_changed_here_is_refused_and_not_replaced(listed, capsys):
    fetch(measured_set("made"), listed)
    (listed / "made" / "one.csv").write_bytes(b"mine")
    with pytest.raises(FileError, match=r"one.csv: not the file of made.*move it away"):
        find_measured("made")
    assert "move it away" in refused(capsys, "made")
    assert (listed / "made" / "one.csv").read_bytes() == b"mine"


def test_a_name_that_is_not_listed_is_answered_with_those_that_are(listed, capsys):
    assert "there are made, drawn" in refused(capsys, "ur55")


# --- fetching


def test_a_set_is_fetched_whole_and_only_once(listed, server, capsys):
    assert main(["data", "made"]) == 0
    assert "2 files fetched" in capsys.readouterr().out
    assert {name: content for name, content in files_in(listed).items() if name != "measured.csv"} == CONTENT
    for path in server[0].iterdir():
        path.unlink()
    assert main(["data", "made"]) == 0 and "here already" in capsys.readouterr().out


def test_another_folder_is_told_to_be_named(listed, tmp_path, capsys):
    assert main(["data", "made", "-o", str(tmp_path / "other")]) == 0
    assert f"GRINDVISION_DATA={tmp_path / 'other'}" in capsys.readouterr().out
    assert files_in(tmp_path / "other") == CONTENT


def test_the_list_says_what_is_here(listed, capsys):
    assert main(["data"]) == 0
    _, made, drawn = capsys.readouterr().out.splitlines()
    assert made.split()[:2] == ["made", "2"] and "cannot be fetched" in drawn
    assert main(["data", "made"]) == 0
    capsys.readouterr()
    assert main(["data", "--json"]) == 0
    told = {one["name"]: one for one in json.loads(capsys.readouterr().out)}
    assert told["made"]["here"] == str(listed) and told["drawn"]["here"] == ""
    assert told["made"]["files"][0]["sha256"] == hashlib.sha256(CONTENT["made/one.csv"]).hexdigest()


def test_what_is_converted_is_not_fetched(listed, capsys):
    assert "it is made from http" in refused(capsys, "drawn")
    assert main(["data", "all"]) == 0
    assert "drawn: left out" in capsys.readouterr().out


# --- what goes wrong: one line, and nothing but whole files is left


def nothing_left(listed):
    assert set(files_in(listed)) == {"measured.csv"} and [p.name for p in listed.iterdir() if p.name[0] == "."] == []


def test_no_network(listed, capsys):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    text = (listed / "measured.csv").read_text()
    there = text.split("http://127.0.0.1:")[1].partition("/")[0]
    (listed / "measured.csv").write_text(text.replace(there, str(port)))
    line = refused(capsys, "made")
    assert "no answer from 127.0.0.1" in line and "GRINDVISION_DATA" in line
    nothing_left(listed)


def test_a_file_that_is_no_longer_there(listed, server, capsys):
    (server[0] / "one.csv").unlink()
    assert "answers 404" in refused(capsys, "made")
    nothing_left(listed)


@pytest.mark.parametrize("content", [b"", b"pose,x_mm\n1,2.6\n", CONTENT["made/one.csv"][:-1], b"<html>moved</html>"])
def test_a_file_that_was_changed_there(listed, server, capsys, content):
    (server[0] / "one.csv").write_bytes(content)
    line = refused(capsys, "made")
    assert "changed since it was listed" in line and f"{len(content)} bytes" in line
    nothing_left(listed)


def test_an_archive_that_is_none_or_lacks_its_member(listed, server, capsys):
    (server[0] / "two.tar.gz").write_bytes(b"no archive")
    assert "no archive with that file" in refused(capsys, "made")
    assert set(files_in(listed)) == {"measured.csv", "made/one.csv"}, "what was whole stays, for the next call"
    with tarfile.open(server[0] / "two.tar.gz", "w:gz"):
        pass
    assert "no archive with that file" in refused(capsys, "made")


def test_an_answer_that_breaks_off(listed, server, capsys, monkeypatch):
    def broken(self):
        self.send_response(200)
        self.send_header("Content-Length", "1000")
        self.end_headers()
        self.wfile.write(b"pose,")
        self.close_connection = True

    monkeypatch.setattr(Quiet, "do_GET", broken)
    refused(capsys, "made")
    nothing_left(listed)


def test_a_full_disk(listed):
    def full(address, path):
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with pytest.raises(OSError, match="No space left"):
        fetch(measured_set("made"), listed, full)
    nothing_left(listed)


def test_a_full_disk_while_pooch_writes_is_one_line(listed, capsys, monkeypatch):
    import pooch

    def full(self, url, output_file, pooch):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pooch.HTTPDownloader, "__call__", full)
    line = refused(capsys, "made")
    assert "No space left on device" in line and "choose another folder" in line
    nothing_left(listed)


def test_a_folder_that_cannot_be_written_to(listed, tmp_path, capsys):
    (tmp_path / "file").write_text("no folder")
    assert "cannot write to" in refused(capsys, "made", "-o", tmp_path / "file")


def test_an_interrupted_download_leaves_nothing(listed):
    def stopped(address, path):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(measured_set("made"), listed, stopped)
    nothing_left(listed)


def test_without_pooch_the_line_to_install_it_is_told(listed, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pooch", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'grindvision\[data\]'"):
        over_http()


def test_no_folder_to_keep_them_in(monkeypatch, capsys):
    monkeypatch.delenv("GRINDVISION_DATA", raising=False)
    monkeypatch.setattr("grindvision.measured.user_cache", lambda: None)
    assert "say where with -o DIR" in refused(capsys, "ur5")
    with pytest.raises(InputError, match="looked into no folder"):
        find_measured("ur5")
