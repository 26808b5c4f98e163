"""Readers of robot programmes for the tests, written from the makers' manuals and sharing no code with the writers.

Each returns the tool in the flange, the work object in the base, and what is said in order: ("joints", angles in deg),
("pose", T_work_tool, speed mm/s, placement words), ("output", name, value), ("wait", s), ("arc", word).
"""

import csv
import json
import math
import re

import numpy as np

NUMBER = r"-?\d+(?:\.\d+)?"


def turn(axis, degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def groups(pattern, text, flags=0):
    """Groups of a pattern that must match the whole text."""
    match = re.fullmatch(pattern, text, flags)
    assert match, text
    return match.groups()


def pose(rotation, place):
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation, place
    return whole


def by_quaternion(place, w, x, y, z):
    """Rotation of a unit quaternion, written out; refuses one that RAPID would (off by more than 1e-5)."""
    assert abs(w * w + x * x + y * y + z * z - 1) < 1e-5
    return pose(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ),
        place,
    )


def numbers(text):
    return [float(word) for word in re.findall(r"-?\d+(?:\.\d+)?(?:E\d+)?", text)]


def read_rapid(text):
    lines = [line.strip() for line in text.split("\r\n")]
    assert lines[0].startswith("MODULE ") and lines[-2:] == ["ENDMODULE", ""] and max(map(len, lines)) < 255
    tool = work = None
    said = []
    for line in lines[1:-2]:
        if match := re.fullmatch(r"! (t|u)frame of \w+ as this programme was made: (.*)", line):
            values = numbers(match[2])
            frame = by_quaternion(values[:3], *values[3:])
            tool, work = (frame, work) if match[1] == "t" else (tool, frame)
        if line.startswith("!") or line.startswith("PROC ") or line == "ENDPROC":
            continue
        assert line.endswith(";"), line
        if match := re.fullmatch(r"PERS (tooldata|wobjdata) \w+:=\[(?:TRUE|FALSE),(?:TRUE,\"\",)?(.*)\];", line):
            values = numbers(match[2])[:7]
            frame = by_quaternion(values[:3], *values[3:])
            tool, work = (frame, work) if match[1] == "tooldata" else (tool, frame)
        elif match := re.fullmatch(r"MoveAbsJ \[\[(.*?)\],.*,fine,\w+\\WObj:=\w+;", line):
            said.append(("joints", numbers(match[1])))
        elif match := re.fullmatch(
            r"(MoveL|ArcLStart|ArcL|ArcLEnd) \[(\[.*?\]),(\[.*?\]),(\[.*?\]),\[9E9.*?\]\],"
            r"\[(.*?)\],(.*),\w+\\WObj:=\w+;",
            line,
        ):
            where, speed = by_quaternion(numbers(match[2]), *numbers(match[3])), numbers(match[5])[0]
            said.append(("pose", where, speed, tuple(int(n) for n in numbers(match[4]))))
            if match[1] != "MoveL":
                said.append(("arc", f"{match[1]} {match[6]}"))
        elif match := re.fullmatch(r"Set([DA])O (\w+),(.*);", line):
            said.append(("output", match[2], bool(int(match[3])) if match[1] == "D" else float(match[3])))
        else:
            match = re.fullmatch(r"WaitTime (.*);", line)
            assert match, line
            said.append(("wait", float(match[1])))
    return tool, work, said


def kuka_frame(text):
    v = {key: float(value) for key, value in re.findall(rf"([XYZABC]) ({NUMBER})", text)}
    return pose(turn("z", v["A"]) @ turn("y", v["B"]) @ turn("x", v["C"]), [v["X"], v["Y"], v["Z"]])


def read_krl(source, data):
    lines = source.split("\r\n")
    points: dict = {}
    (name,) = groups(r"DEF (\w{1,24})\(\)", lines[0])
    rows = data.split("\r\n")
    assert rows[0] == f"DEFDAT {name}" and rows[-2:] == ["ENDDAT", ""] and lines[-2:] == ["END", ""]
    for row in rows[1:-2]:
        point, frame, status, turns = groups(r"DECL POS (\w+)=\{(.*),S (\d+),T (\d+)\}", row)
        points[point] = kuka_frame(frame), (int(status), int(turns))
    tool = work = speed = None
    said = []
    for line in lines[1:-2]:
        if match := re.fullmatch(r"; (TOOL|BASE)_DATA\[\d+\] as this programme was made: \{(.*)\}", line):
            tool, work = (kuka_frame(match[2]), work) if match[1] == "TOOL" else (tool, kuka_frame(match[2]))
            continue
        if line.startswith((";", "BAS(", "$IPO_MODE", "$APO.CDIS")):
            continue
        if match := re.fullmatch(r"\$(TOOL|BASE)=\{(.*)\}", line):
            tool, work = (kuka_frame(match[2]), work) if match[1] == "TOOL" else (tool, kuka_frame(match[2]))
        elif match := re.fullmatch(r"PTP \{(.*)\}", line):
            said.append(("joints", [float(v) for _, v in re.findall(rf"A([1-6]) ({NUMBER})", match[1])]))
        elif match := re.fullmatch(r"\$VEL\.CP=(.*)", line):
            speed = 1000 * float(match[1])
        elif match := re.fullmatch(r"LIN (\w+)( C_DIS)?", line):
            said.append(("pose", points[match[1]][0], speed, points[match[1]][1]))
        elif match := re.fullmatch(r"\$(AN)?OUT\[(\d+)\]=(.*)", line):
            said.append(("output", match[2], float(match[3]) if match[1] else match[3] == "TRUE"))
        else:
            match = re.fullmatch(r"WAIT SEC (.*)", line)
            assert match, line
            said.append(("wait", float(match[1])))
    return tool, work, said


def fixed_axes(x, y, z, rx, ry, rz):
    return pose(turn("z", rz) @ turn("y", ry) @ turn("x", rx), [x, y, z])


def read_ls(text):
    head, rest = text.split("/MN\r\n")
    body, positions = rest.split("/POS\r\n")
    assert re.match(r"/PROG  [A-Z][A-Z0-9_]{0,7}\r\n", head) and positions.endswith("/END\r\n")
    places: dict = {}
    for number, inside in re.findall(r"P\[(\d+)\]\{(.*?)\};", positions, re.S):
        if match := re.search(r"CONFIG : '([NF] [UD] [TB], 0, 0, 0)'", inside):
            values = [
                float(groups(rf".*\b{letter} = ({NUMBER}) {unit}.*", inside, re.S)[0])
                for letter, unit in zip("XYZWPR", ["mm"] * 3 + ["deg"] * 3, strict=True)
            ]
            places[number] = fixed_axes(*values), match[1]
        else:
            places[number] = [float(v) for v in re.findall(rf"J\d= ({NUMBER}) deg", inside)]
    said, numbered = [], []
    remarks: dict = {}
    for line in body.split("\r\n")[:-1]:
        number, words = groups(r" *(\d+): *(.*) ;", line)
        numbered.append(int(number))
        if match := re.fullmatch(rf"!(U[TF])\d+ ([XYZWPR]) ({NUMBER})", words):
            remarks.setdefault(match[1], []).append(float(match[3]))
        elif words.startswith(("!", "UFRAME_NUM=", "UTOOL_NUM=")):
            assert len(words) <= 33
        elif match := re.fullmatch(r"J P\[(\d+)\] \d+% FINE", words):
            said.append(("joints", places[match[1]]))
        elif match := re.fullmatch(r"L P\[(\d+)\] (\d+)(mm/sec|cm/min) (FINE|CNT100)", words):
            said.append(
                ("pose", places[match[1]][0], int(match[2]) / (1 if match[3] == "mm/sec" else 6), places[match[1]][1])
            )
        elif match := re.fullmatch(r"([DA])O\[(\d+)\]=(.*)", words):
            said.append(("output", match[2], match[3] == "ON" if match[1] == "D" else float(match[3])))
        else:
            match = re.fullmatch(r"WAIT (.*)\(sec\)", words)
            assert match, words
            said.append(("wait", float(match[1])))
    assert numbered == list(range(1, len(numbered) + 1)) and f"LINE_COUNT\t= {len(numbered)};" in head
    return fixed_axes(*remarks["UT"]), fixed_axes(*remarks["UF"]), said


def read_jbi(text):
    head, rest = text.split("//INST\r\n")
    lines = head.split("\r\n")
    assert lines[0] == "/JOB" and re.fullmatch(r"//NAME [A-Z][A-Z0-9_]{0,31}", lines[1])
    places: dict = {}
    flags = kind = count = None
    for line in lines[2:-1]:
        if line.startswith("///POSTYPE"):
            kind = line.split()[1]
        elif line.startswith("///RCONF"):
            flags = tuple(int(word) for word in line.split()[1].split(","))
        elif line.startswith("///NPOS"):
            count = int(line.split()[1].split(",")[0])
        elif match := re.fullmatch(r"C(\d{5})=(.*)", line):
            values = [float(word) for word in match[2].split(",")]
            places[match[1]] = values if kind == "ANGLE" else (fixed_axes(*values), flags)
    assert count == len(places) and rest.endswith("END\r\n")
    said = []
    remarks: dict = {}
    for line in rest.split("\r\n")[:-2]:
        if match := re.fullmatch(rf"'(TOOL|USER)\d+ R?[XYZ] ({NUMBER})", line):
            remarks.setdefault(match[1], []).append(float(match[2]))
        elif line.startswith(("///", "'", "NOP")):
            assert len(line) <= 33
        elif match := re.fullmatch(r"MOVJ C(\d{5}) VJ=(\d+\.\d\d) PL=0", line):
            said.append(("joints", places[match[1]]))
        elif match := re.fullmatch(r"MOVL C(\d{5}) V=(\d+\.\d) PL=[01]", line):
            said.append(("pose", places[match[1]][0], float(match[2]), places[match[1]][1]))
        elif match := re.fullmatch(r"([DA])OUT [OA][TO]#\((\d+)\) (.*)", line):
            said.append(("output", match[2], match[3] == "ON" if match[1] == "D" else float(match[3])))
        else:
            match = re.fullmatch(r"TIMER T=(.*)", line)
            assert match, line
            said.append(("wait", float(match[1])))
    return fixed_axes(*remarks["TOOL"]), fixed_axes(*remarks["USER"]) if "USER" in remarks else np.eye(4), said


def by_rotation_vector(x, y, z, rx, ry, rz):
    """Pose of URScript's literal, metres and a rotation vector, by Rodrigues' formula; mm."""
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    k = np.zeros((3, 3)) if angle < 1e-12 else np.array([[0, -rz, ry], [rz, 0, -rx], [-ry, rx, 0]]) / angle
    return pose(np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k, [1000 * x, 1000 * y, 1000 * z])


def read_urscript(text):
    """As the others; poses stand in the base, so the work object is the base."""
    lines = text.split("\n")
    assert re.fullmatch(r"def \w+\(\):", lines[0]) and lines[-2:] == ["end", ""]
    tool, said = None, []
    literal = r"p\[(.*?)\]"
    for line in (line.strip() for line in lines[1:-2]):
        if match := re.fullmatch(rf"(?:set_tcp\({literal}\)|# TCP \w+ as this was made: {literal})", line):
            tool = by_rotation_vector(*numbers(match[1] or match[2]))
        elif line.startswith("#"):
            continue
        elif match := re.fullmatch(r"movej\(\[(.*)\], a=.*, v=.*\)", line):
            said.append(("joints", [math.degrees(angle) for angle in numbers(match[1])]))
        elif match := re.fullmatch(rf"move[lp]\({literal}, a=[\d.]+, v=([\d.]+)(?:, r=[\d.]+)?\)", line):
            said.append(("pose", by_rotation_vector(*numbers(match[1])), 1000 * float(match[2]), ()))
        elif match := re.fullmatch(r"set_standard_(digital|analog)_out\((\d+), (.*)\)", line):
            said.append(("output", match[2], match[3] == "True" if match[1] == "digital" else float(match[3])))
        else:
            said.append(("wait", float(groups(r"sleep\((.*)\)", line)[0])))
    return tool, np.eye(4), said


def read_steps_json(text):
    content = json.loads(text)
    assert content["units"] == {"length": "mm", "angle": "rad", "time": "s"}
    said = []
    for step in content["steps"]:
        if step["kind"] == "joint move":
            said.append(("joints", np.degrees(step["q_rad"]).tolist()))
        elif step["kind"] == "linear move":
            said.append(("pose", np.array(step["T_work_tool"]), step["speed_mm_s"], ()))
        elif step["kind"] == "output":
            said.append(("output", step["output"], step["value"]))
        elif step["kind"] == "wait":
            said.append(("wait", step["seconds"]))
    return np.array(content["T_flange_tool"]), np.array(content["T_base_work"]), said


def read_steps_csv(text):
    frames, said = {}, []
    lines = text.split("\n")
    while match := re.fullmatch(r"# (\w+): (.*)", lines[0]):
        frames[match[1]] = np.vstack([np.array(numbers(match[2])).reshape(3, 4), [0, 0, 0, 1]])
        lines.pop(0)
    for row in csv.DictReader(lines):
        if row["kind"] == "joint move":
            said.append(("joints", [math.degrees(float(v)) for k, v in row.items() if re.fullmatch(r"J\d_rad", k)]))
        elif row["kind"] == "linear move":
            values = [float(row[key]) for key in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")]
            said.append(("pose", by_quaternion(values[:3], *values[3:]), float(row["speed_mm_s"]), ()))
        elif row["kind"] == "output":
            word = row["value"]
            said.append(("output", row["output"], word == "true" if word in ("true", "false") else float(word)))
        elif row["kind"] == "wait":
            said.append(("wait", float(row["seconds"])))
    return frames["T_flange_tool"], frames["T_base_work"], said
