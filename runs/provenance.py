"""Where a run came from: revision of this software and versions of what it stands on."""

import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

_PACKAGES: Final = ("reedbench", "numpy", "scipy", "h5py", "pydantic", "event-model")
_PATIENCE_S: Final = 5.0


def git_revision() -> str | None:
    """Return the git revision of this software, with ``-dirty`` if it was changed since.

    Returns
    -------
    str or None
        None if there is no git, or this software does not lie in a checkout of its own (it may
        be installed inside somebody else's).
    """
    here = Path(__file__)
    tracked = _git(here.parent, "ls-files", "--error-unmatch", here.name)
    return _git(here.parent, "describe", "--always", "--dirty", "--abbrev=40") if tracked else None


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        answer = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
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
