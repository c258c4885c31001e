"""ziglang for the tests that need it."""

import os
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest

from bayesrace.cache import software
from tests.shared import shared_folder

__all__ = ["ziglang"]


@pytest.fixture(scope="session")
def ziglang() -> None:
    """Skips without ziglang; with it, what it has built for other tests and runs is used again.

    The first time, it builds a C library for each target, which takes minutes for Windows. It keeps
    that for the path of its own library, which is another one in each virtual environment.
    """
    spec = find_spec("ziglang")
    if spec is None or spec.origin is None:
        pytest.skip("ziglang is not installed (pip install ziglang)")
    library = Path(spec.origin).parent / "lib"
    folder = shared_folder(
        "ziglang",
        software((), ("ziglang",)),
        lambda copy: shutil.copytree(library, copy / "lib", copy_function=_linked),
    )
    os.environ["ZIG_LIB_DIR"] = str(folder / "lib")


def _linked(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system
        shutil.copy2(source, target)
