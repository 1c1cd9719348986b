import json
import platform
import subprocess
import sys

import pytest

from ba_torchrl.core import malloc

GLIBC = platform.system() == "Linux" and platform.libc_ver()[0] == "glibc"

# Counts the page faults of filling a 64 MB block again and again, as an update does.
COUNT_FAULTS = """
import ctypes, json, resource, sys
from ba_torchrl.core.malloc import tune_malloc

results = [tune_malloc(), tune_malloc()] if sys.argv[1] == "tuned" else []
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.malloc.argtypes = [ctypes.c_size_t]
libc.free.argtypes = [ctypes.c_void_p]

def fill():
    block = libc.malloc(64 << 20)
    ctypes.memset(block, 1, 64 << 20)
    libc.free(block)

fill()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    fill()
faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(json.dumps([results, faults]))
"""


def count_faults(how):
    command = [sys.executable, "-c", COUNT_FAULTS, how]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.skipif(not GLIBC, reason="the settings are glibc's")
def test_freed_pages_are_kept():
    results, tuned = count_faults("tuned")
    assert results == [True, True]
    _, untuned = count_faults("untuned")
    # with huge pages, 160
    assert tuned < untuned / 4 > 20


@pytest.mark.parametrize(
    ("system", "libc"), [("Darwin", ("", "")), ("Windows", ("", "")), ("Linux", ("musl", "1.2"))]
)
def test_does_nothing_elsewhere(monkeypatch, system, libc):
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "libc_ver", lambda: libc)
    monkeypatch.setattr(malloc.ctypes, "CDLL", lambda name: pytest.fail("libc was opened"))
    assert malloc.tune_malloc.__wrapped__() is False
