"""The arithmetic of the book, pinned: two x86-64 machines with AVX2 take the same instructions to the same sums.

Compilers and libraries choose other instructions on other processors, and sums of floating-point numbers end in other
last digits. Here the target of numba's compiler, OpenBLAS's kernels and NumPy's are set to what every such machine has.
Run as a script, it prints the settings for a shell (``./run`` evaluates them).
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

#: x86-64-v3, the level of Haswell and Zen: what numba compiles for, whatever the machine offers beyond.
FEATURES = "+avx,+avx2,+bmi,+bmi2,+cx16,+f16c,+fma,+lzcnt,+movbe,+popcnt,+sse3,+sse4.1,+sse4.2,+ssse3"

PINS = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": FEATURES,
    "OPENBLAS_CORETYPE": "Haswell",
}

#: The levels above it that NumPy dispatches to, as NumPy 2.4 names them and as earlier versions did.
NUMPY_LEVELS = ("X86_V4", "AVX512_ICL", "AVX512_SPR")
EARLIER_NUMPY_LEVELS = ("AVX512F", "AVX512CD", "AVX512_SKX", "AVX512_CLX", "AVX512_CNL", "AVX512_ICL", "AVX512_SPR")


def pins(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Settings of the arithmetic that ``environment`` lacks; of the threads alone on other machines than described."""
    wanted = {name: value for name, value in PINS.items() if name.endswith("_NUM_THREADS")}
    flags = _processor_flags()
    if "avx2" in flags and "fma" in flags:
        wanted |= PINS
        if "avx512f" in flags:
            wanted["NPY_DISABLE_CPU_FEATURES"] = " ".join(_numpy_levels(flags))
    return {name: value for name, value in wanted.items() if name not in environment}


def pin() -> None:
    """Set them for this process and those that it starts; call it before NumPy and numba are imported."""
    os.environ.update(pins())


def _numpy_levels(flags: frozenset[str]) -> tuple[str, ...]:
    """Names of the levels that this machine has: NumPy warns of one that it could not use anyway."""
    from importlib.metadata import version

    numpy = tuple(int(part) for part in version("numpy").split(".")[:2])
    levels = NUMPY_LEVELS if numpy >= (2, 4) else EARLIER_NUMPY_LEVELS
    absent = set()
    if "avx512_bitalg" not in flags:
        absent.add("AVX512_ICL")
    if "avx512_fp16" not in flags:
        absent.add("AVX512_SPR")
    if "avx512_vnni" not in flags:
        absent.add("AVX512_CLX")
    if "avx512vbmi" not in flags:
        absent.add("AVX512_CNL")
    return tuple(level for level in levels if level not in absent)


def _processor_flags() -> frozenset[str]:
    """The processor's features in lower case; none where this is no x86-64 machine with Linux or macOS."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return frozenset()
    if sys.platform == "linux":
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return frozenset(next((line for line in lines if line.startswith("flags")), "").lower().split())
    if sys.platform == "darwin":
        asked = ["sysctl", "-n", "machdep.cpu.features", "machdep.cpu.leaf7_features"]
        return frozenset(subprocess.run(asked, capture_output=True, text=True, check=False).stdout.lower().split())
    return frozenset()


if __name__ == "__main__":
    print("\n".join(f"export {name}='{value}'" for name, value in pins().items()))
