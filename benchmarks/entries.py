"""Racers as they are entered in a race: their room under ``peers/``, task and settings."""

from __future__ import annotations

from benchmarks.racing import Racer


def ours(name: str, task: str, about: str, kind: str = "ours", **settings: object) -> Racer:
    """One of our own racers."""
    room = {"groove": "welding", "calibrate": "calibration", "hand_eye": "calibration"}.get(task, "grinding")
    return Racer(name, f"ours_{room}:{task}", kind, settings, about)


def open3d(name: str, task: str, about: str, **settings: object) -> Racer:
    """A racer of Open3D."""
    return Racer(name, f"open3d_peer:{task}", "peer", settings, about, "open3d")


def small_gicp(name: str, task: str, about: str, **settings: object) -> Racer:
    """A racer of small_gicp."""
    return Racer(name, f"small_gicp_peer:{task}", "peer", settings, about, "small_gicp")


def pcl(name: str, task: str, about: str, **settings: object) -> Racer:
    """A racer of PCL, a program."""
    return Racer(name, f"pcl_peer:{task}", "peer", settings, about, "PCL", warm_up=False)


def process(name: str, kind: str, *words: str, needs: str = "", compiled: bool = True, about: str = "") -> Racer:
    """A whole process."""
    settings = {"words": list(words), "compiled": compiled}
    about = about or "`" + " ".join(words).replace("{", "").replace("}", "") + "`"
    return Racer(name, "startup:process", kind, settings, about, needs, warm_up=False)
