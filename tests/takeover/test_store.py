"""What is accepted is kept: it survives its controller, and a disk that is full."""

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bayesrace.errors import InputError
from bayesrace.gp.weights import encode_weights, zero_weights
from bayesrace.vehicles import CarParameters
from controller.gate.store import HISTORY, Accepted, Store, digest_of, trimmed


def accepted(car: CarParameters, number: int, proven: bool = True) -> Accepted:
    version = f"v{number}"
    data = encode_weights(zero_weights(car.name, "d", version))
    return Accepted(number, version, data, proven, accepted_utc_ns=number * 10**9)


@contextmanager
def full_disk(free_bytes: int) -> Iterator[None]:
    """No file can become longer than that: what a disk that fills up does to a writer."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_what_is_kept_is_found_again(tmp_path: Path, car: CarParameters) -> None:
    store = Store(tmp_path / "new" / "store", "d")
    assert (store.load(), store.next_number) == ([], 1)
    history = [Accepted(0, "", b"", True), accepted(car, 1), accepted(car, 2, proven=False)]
    given_up = digest_of(b"bad")
    store.keep(history, 3, [given_up])
    again = Store(tmp_path / "new" / "store", "d")
    assert again.load() == history[1:]
    assert (again.next_number, again.withdrawn) == (3, (given_up,))
    again.keep(history[:2], 3)  # rolled back
    assert Store(tmp_path / "new" / "store", "d").load() == history[1:2]
    assert len(list((tmp_path / "new" / "store").iterdir())) == 2


def test_the_store_keeps_the_newest_and_a_proven_one(tmp_path: Path, car: CarParameters) -> None:
    store = Store(tmp_path, "d")
    history: list[Accepted] = []
    for number in range(1, 15):
        history = trimmed([*history, accepted(car, number, proven=number == 2)])
        store.keep(history, number + 1)
    numbers = [one.number for one in Store(tmp_path, "d").load()]
    assert numbers == [2, *range(15 - HISTORY, 15)]
    assert len(list(tmp_path.glob("*.bin"))) == HISTORY + 1


def test_a_store_of_another_model_or_a_damaged_one_is_refused(
    tmp_path: Path, car: CarParameters
) -> None:
    Store(tmp_path, "d").keep([accepted(car, 1)], 2)
    with pytest.raises(InputError, match="predicts with e; choose another folder"):
        Store(tmp_path, "e")
    (tmp_path / "index.json").write_text("{")
    with pytest.raises(InputError, match="is damaged"):
        Store(tmp_path, "d")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose another folder"):
        Store(tmp_path / "file", "d")


def test_a_file_that_is_not_what_the_index_says_is_passed_over(
    tmp_path: Path, car: CarParameters
) -> None:
    Store(tmp_path, "d").keep([accepted(car, 1), accepted(car, 2)], 3)
    newest = max(tmp_path.glob("*.bin"))
    newest.write_bytes(newest.read_bytes()[:-1])
    assert [one.number for one in Store(tmp_path, "d").load()] == [1]
    index = json.loads((tmp_path / "index.json").read_text())
    index["entries"][0]["file"] = "../elsewhere.bin"
    (tmp_path / "index.json").write_text(json.dumps(index))
    with pytest.raises(InputError, match="is damaged"):
        Store(tmp_path, "d")


def test_of_a_store_without_times_all_are_older_than_any_other(
    tmp_path: Path, car: CarParameters
) -> None:
    Store(tmp_path, "d").keep([accepted(car, 1)], 2)
    index = json.loads((tmp_path / "index.json").read_text())
    del index["entries"][0]["accepted_utc_ns"]
    (tmp_path / "index.json").write_text(json.dumps(index))
    assert [one.accepted_utc_ns for one in Store(tmp_path, "d").load()] == [0]


@pytest.mark.parametrize("free_bytes", [0, 100])
def test_a_full_disk_leaves_what_was_kept_before(
    tmp_path: Path, car: CarParameters, free_bytes: int
) -> None:
    """And nothing else; what could not be kept is kept as soon as it can."""
    history = [accepted(car, 1), accepted(car, 2)]
    store = Store(tmp_path, "d")
    store.keep(history[:1], 2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with full_disk(free_bytes):
        with pytest.raises(InputError, match="File too large"):
            store.keep(history, 3)
        with pytest.raises(InputError, match="File too large"):
            store.keep([], 3)  # the index alone
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    store.keep(history[1:], 3)
    assert Store(tmp_path, "d").load() == history[1:]
    assert len(list(tmp_path.iterdir())) == 2
