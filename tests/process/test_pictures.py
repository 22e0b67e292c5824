"""The store of decoded stills: what it keeps and what it forgets."""

import platform
import subprocess
import sys

import numpy as np
import pytest

from tests.process.made_blocks import MadeStills
from uavkit.core.errors import InputError
from uavkit.process.pictures import PictureStore


def _stills(count: int, shape: tuple[int, ...] = (100, 100)) -> MadeStills:
    return MadeStills({f"{n}.JPG": np.full(shape, n, dtype=np.uint8) for n in range(count)})


def test_a_still_is_read_once_while_it_is_kept() -> None:
    source = _stills(3)
    store = PictureStore(source, ("2.JPG", "0.JPG"))
    assert len(store) == 2
    assert store.grey(0)[0, 0] == 2  # rows follow the names given, not the source's order
    assert store.grey(1)[0, 0] == 0
    store.grey(0)
    assert source.reads == {"2.JPG": 1, "0.JPG": 1}
    assert store.fingerprint(0) == source.fingerprint("2.JPG")


def test_the_least_recently_used_is_forgotten_first() -> None:
    source = _stills(4)
    store = PictureStore(source, tuple(source.pictures), capacity_mb=0.03)  # three pictures of 10 kB
    for index in (0, 1, 2, 0, 3):  # 1 is the oldest when 3 comes
        store.grey(index)
    for index in (0, 2, 3):
        store.grey(index)
    assert source.reads == {"0.JPG": 1, "1.JPG": 1, "2.JPG": 1, "3.JPG": 1}
    store.grey(1)
    assert source.reads["1.JPG"] == 2


def test_two_stills_stay_however_large_they_are() -> None:
    source = _stills(2)
    store = PictureStore(source, tuple(source.pictures), capacity_mb=0.001)
    for _ in range(3):
        store.grey(0)
        store.grey(1)
    assert source.reads == {"0.JPG": 1, "1.JPG": 1}


def test_colours_for_grey_values_are_refused() -> None:
    with pytest.raises(InputError, match=r"0.JPG.*\(height, width\)"):
        PictureStore(_stills(1, (10, 10, 3)), ("0.JPG",)).grey(0)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library gives memory back in its own way")
def test_freed_pictures_go_back_to_the_system() -> None:
    """In a process of its own: pictures made and freed by threads, with small things kept in between."""
    program = """
import numpy as np
from concurrent.futures import ThreadPoolExecutor
from uavkit.process.pictures import return_freed_memory
return_freed_memory()
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096
before, kept = resident(), []
def work(number):
    pictures = [np.ones((3000, 2000 + 100 * (number % 7)), np.uint8) for _ in range(3)]
    kept.append(np.ones(10_000))
with ThreadPoolExecutor(4) as pool:
    list(pool.map(work, range(60)))
print(resident() - before - sum(each.nbytes for each in kept))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 20e6  # not one picture
