"""What pyproject.toml cannot say: the package holds the files of data/, and its addresses are those of the checkout."""

import os
import re
import shutil
import subprocess
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent

#: Made by a user in a checkout.
OWN = shutil.ignore_patterns("synthetic", ".*", "__pycache__")


class BuildWithData(build_py):
    """Copies ``data/`` to ``grindvision/data``; an editable installation reads it where it is."""

    def run(self) -> None:
        """Build the modules, then copy."""
        super().run()
        if not self.editable_mode:
            shutil.copytree(ROOT / "data", Path(self.build_lib, "grindvision", "data"), ignore=OWN, dirs_exist_ok=True)


def addresses() -> dict[str, str]:
    """Repository, pages and issues of the GitHub repository that this checkout was cloned from; empty for another."""
    origin = f"{os.environ.get('GITHUB_SERVER_URL', '')}/{os.environ.get('GITHUB_REPOSITORY', '')}"
    if not os.environ.get("GITHUB_REPOSITORY"):
        command = ["git", "-C", str(ROOT), "remote", "get-url", "origin"]
        try:
            origin = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError):
            return {}
    found = re.search(r"github\.com[/:]([\w.-]+)/([\w.-]+?)(?:\.git)?/?$", origin)
    if not found:
        return {}
    owner, name = found.groups()
    repository = f"https://github.com/{owner}/{name}"
    pages = f"https://{owner.lower()}.github.io/{name}/"
    return {"Repository": repository, "Documentation": pages, "Issues": f"{repository}/issues"}


setup(cmdclass={"build_py": BuildWithData}, project_urls=addresses())
