"""Provenance of a run: the revision of this software and the versions of packages it uses."""

import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

_PACKAGES: Final = ("reedbench", "numpy", "scipy", "h5py", "pydantic", "event-model")
# Longest wait for git. Chosen: git answers within 0.1 s on a local disk.
_TIMEOUT_S: Final = 5.0


def git_revision() -> str | None:
    """Return the git revision of this software, with ``-dirty`` if files were changed since.

    Returns
    -------
    str or None
        None if git is not installed, or this software is not in a git checkout of its own (it may
        be installed inside the checkout of another project).
    """
    file = Path(__file__)
    tracked = _git(file.parent, "ls-files", "--error-unmatch", file.name)
    return _git(file.parent, "describe", "--always", "--dirty", "--abbrev=40") if tracked else None


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        answer = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that numbers in a run depend on."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions
