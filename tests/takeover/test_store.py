"""What is accepted is kept: it survives its controller."""

from pathlib import Path

import pytest

from bayesrace.controller.weights.store import HISTORY, AcceptedWeights, History, Store, digest_of
from bayesrace.errors import InputError
from bayesrace.gp.weights import encode_weights, pack_weights, zero_weights
from bayesrace.vehicles import Car

START = AcceptedWeights(number=0, version="", digest=digest_of(b""), proven=True)


def history(car: Car, *proven: bool) -> History:
    """Weights that have been accepted one after the other, after those at the start."""
    made = History(discretisation="d", entries=[START])
    for one in proven:
        weights = zero_weights(car.name, "d", f"v{made.next_number}")
        made.accept(weights.version, encode_weights(weights), pack_weights(weights), one)
    return made


def numbers(folder: Path) -> list[int]:
    """Of the weights that a controller started now finds."""
    return [one.number for one in Store(folder, "d").restore(START).entries]


def test_what_is_kept_is_found_again(tmp_path: Path, car: Car) -> None:
    folder = tmp_path / "new" / "store"
    store = Store(folder, "d")
    assert store.restore(START).entries == [START]
    kept = history(car, True, False, False)
    kept.roll_back(kept.entries[2], withdraw=True)
    store.keep(kept)
    found = Store(folder, "d").restore(START)
    assert found.entries == kept.entries
    assert (found.next_number, len(found.withdrawn)) == (4, 1)
    found.roll_back(found.entries[1], withdraw=False)
    store.keep(found)
    assert numbers(folder) == [0, 1]
    assert len(list(folder.iterdir())) == 2


def test_the_store_keeps_the_newest_and_a_proven_one(tmp_path: Path, car: Car) -> None:
    kept = history(car, *(number == 2 for number in range(1, 15)))
    Store(tmp_path, "d").keep(kept)
    assert numbers(tmp_path) == [0, 2, *range(15 - HISTORY, 15)]
    assert kept.reference.number == 2
    assert len(list(tmp_path.glob("*.bin"))) == HISTORY + 1


def test_a_store_of_another_model_or_a_damaged_one_is_refused(tmp_path: Path, car: Car) -> None:
    Store(tmp_path, "d").keep(history(car, True))
    with pytest.raises(InputError, match="weights for d, not for e; choose another folder"):
        Store(tmp_path, "e")
    for damaged in ("{", '{"entries": [{"number": 1}]}'):
        (tmp_path / "index.json").write_text(damaged)
        with pytest.raises(InputError, match="is damaged"):
            Store(tmp_path, "d")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose another folder"):
        Store(tmp_path / "file", "d")


def test_a_damaged_file_is_left_out(tmp_path: Path, car: Car) -> None:
    Store(tmp_path, "d").keep(history(car, True, True))
    newest = max(tmp_path.glob("*.bin"))
    newest.write_bytes(newest.read_bytes()[:-1])
    assert numbers(tmp_path) == [0, 1]
