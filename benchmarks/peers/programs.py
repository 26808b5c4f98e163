"""Programs among the peers: ours for PCL, built here where its libraries are present, and CloudCompare's own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np

from benchmarks.peers.laps import Answer
from grindvision.errors import GrindvisionError
from grindvision_book.machinery.places import BUILD

SOURCES = Path(__file__).parent
PROGRAMS = BUILD / "peers"
PCL_PARTS = ("pcl_registration", "pcl_surface", "pcl_segmentation", "pcl_features", "pcl_filters")


def build_pcl() -> str:
    """Build the PCL programs that are missing or older than their sources; returns why there are none, or nothing."""
    for tool in ("g++", "pkg-config"):
        if shutil.which(tool) is None:
            return f"no {tool} (Debian, Ubuntu: apt-get install g++ pkg-config libpcl-dev)"
    flags = subprocess.run(["pkg-config", "--cflags", "--libs", *PCL_PARTS], capture_output=True, text=True)
    if flags.returncode:
        return "PCL's headers are not installed (Debian, Ubuntu: apt-get install libpcl-dev)"
    changed = max(header.stat().st_mtime for header in SOURCES.glob("*.h"))
    PROGRAMS.mkdir(parents=True, exist_ok=True)
    for name in ("pcl_grind", "pcl_weld"):
        source, program = SOURCES / f"{name}.cpp", PROGRAMS / name
        if program.is_file() and program.stat().st_mtime > max(changed, source.stat().st_mtime):
            continue
        command = ["g++", "-O3", "-fopenmp", "-std=c++17", str(source), "-o", str(program), *flags.stdout.split()]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if "error" in line] or ["no word from the compiler"]
            return f"{source.name} could not be built: {lines[0]}"
    return ""


def run_pcl(name: str, *words: object) -> Answer:
    """Run one of the PCL programs; its own clock, without the start of the process, is the one that counts."""
    done = subprocess.run([str(PROGRAMS / name), *map(str, words)], capture_output=True, text=True)
    if done.returncode:
        raise GrindvisionError(f"{name} failed: {done.stderr.strip() or done.returncode}")
    answer = json.loads(done.stdout)
    for key in ("T_sample_test", "path"):
        if key in answer:
            answer[key] = np.array(answer[key], dtype=float).reshape(-1, 4 if key == "T_sample_test" else 3)
    return answer


def run_cloudcompare(*words: object) -> str:
    """Run CloudCompare without a window and return its log."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    command = ["CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    if done.returncode:
        raise GrindvisionError(f"CloudCompare failed: {done.stderr.strip()[-200:] or done.returncode}")
    return done.stdout
