"""Compiled functions work without a folder in which they can be kept."""

import re
import warnings
from pathlib import Path

import numba
import pytest
from numba.core import caching

import ba_torchrl
from ba_torchrl.core import jit

PACKAGE = Path(ba_torchrl.__file__).parent


def twice(x):
    return 2 * x


def test_without_a_writable_folder_functions_are_compiled_after_one_warning(monkeypatch):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    jit._warn_once.cache_clear()
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR"):
        assert jit.njit(nogil=True)(twice)(21) == 42
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jit.njit()(twice)(4) == 8


def test_other_errors_of_the_compiler_are_raised(monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("no compiler")

    monkeypatch.setattr(numba, "njit", fail)
    with pytest.raises(RuntimeError, match="no compiler"):
        jit.njit()(twice)(21)


def test_all_functions_are_compiled_by_this_decorator():
    importing = [
        path.name
        for path in PACKAGE.rglob("*.py")
        if re.search(r"^\s*(import|from) numba", path.read_text(), re.MULTILINE)
    ]
    assert importing == ["jit.py"]
