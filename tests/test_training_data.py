"""Where samples come from: plain arrays and logs, one car, one discretisation, or a reason."""

import json
import sys
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from bayesrace.errors import InputError
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import (
    dataset_from_log,
    dataset_from_npz,
    log_facts,
    read_samples,
    write_npz,
)
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import encode
from bayesrace.vehicles import car_text
from bayesrace.vehicles.models import dynamic
from tests.driven import CAR, STEP_S, drive, telemetry, write_log


@pytest.fixture(scope="module")
def driven() -> Dataset:
    return drive(dynamic(CAR), 60, seed=1)


@pytest.fixture(scope="module")
def other() -> Dataset:
    return drive(dynamic(CAR), 40, seed=2)


def save(path: Path, data: Dataset, **changes: Any) -> Path:
    arrays: dict[str, Any] = {
        "car": "orca", "step_s": STEP_S, "x": data.x, "u": data.u, "x_next": data.x_next,
    }  # fmt: skip
    arrays |= changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def same(a: Dataset, b: Dataset) -> bool:
    return a.digest() == b.digest()


# Arrays ------------------------------------------------------------------------------------------


def test_samples_and_unbroken_drives_are_read(tmp_path: Path, driven: Dataset) -> None:
    write_npz(tmp_path / "a.npz", driven)
    assert same(dataset_from_npz(tmp_path / "a.npz"), driven)
    states = np.vstack((driven.x, driven.x_next[-1:]))
    np.savez(tmp_path / "b.npz", car="orca", step_s=STEP_S, states=states, inputs=driven.u)
    assert same(dataset_from_npz(tmp_path / "b.npz", CAR, STEP_S), driven)


def test_the_published_form_is_a_drive_and_needs_car_and_step(
    tmp_path: Path, driven: Dataset
) -> None:
    """Its angles are those at the ends of the steps; zero columns that pad it are left out."""
    path, steering = tmp_path / "p.npz", np.vstack((driven.u[:, 0], driven.x_next[:, 6]))
    states = np.pad(np.vstack((driven.x, driven.x_next[-1:])).T, ((0, 0), (0, 2)))
    steering = np.pad(steering, ((0, 0), (0, 2)))
    for rows in (6, 7):
        np.savez(path, states=states[:rows], inputs=steering, time=np.arange(3), dstates=states)
        found = dataset_from_npz(path, CAR, STEP_S)
        assert np.array_equal(found.x, driven.x)
        assert found.u == pytest.approx(driven.u)
    with pytest.raises(InputError, match="does not name its car"):
        dataset_from_npz(path)
    np.savez(path, states=states, inputs=steering, time=np.arange(3))
    with pytest.raises(InputError, match="predictions of a model"):
        dataset_from_npz(path, CAR, STEP_S)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"car": None}, "need 'car'"),
        ({"x": None, "u": None, "x_next": None, "states": np.zeros((6, 4))}, "need 'car'"),
        ({"step_s": None}, "need 'car'"),
        ({"x_next": None}, "need 'car'"),
        ({"inputs": np.zeros((3, 2))}, "need 'car'"),
        ({"x_nxt": np.zeros((3, 2))}, "need 'car'"),
        ({"x": np.zeros((60, 6))}, "shape"),
        ({"x": 3.0}, "shape"),
        ({"x": None, "u": None, "x_next": None, "states": 3.0, "inputs": 4.0}, "shape"),
        ({"u": np.zeros((59, 2))}, "shape"),
        ({"u": np.full((60, 2), np.nan)}, "not finite"),
        ({"u": np.full((60, 2), "a")}, "no numbers"),
        ({"u": np.zeros((60, 2), dtype=complex)}, "no numbers"),
        ({"x": np.array([{}] * 60)}, "pickle"),
        ({"car": np.array({"name": "orca"}, dtype=object)}, "pickle"),
        ({"car": "batmobile"}, "batmobile"),
        ({"car": 7}, "one text"),
        ({"step_s": [0.02, 0.02]}, "step_s"),
        ({"step_s": 0.0}, "step_s"),
        ({"step_s": float("nan")}, "step_s"),
        ({"step_s": "0.02"}, "no numbers"),
    ],
)
def test_other_arrays_are_refused_with_the_reason(
    tmp_path: Path, driven: Dataset, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words) as refusal:
        dataset_from_npz(save(tmp_path / "x.npz", driven, **changes))
    assert "x.npz" in str(refusal.value)


def test_what_is_no_file_of_arrays_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"nothing", b"PK\x03\x04 and so on", b"\x93NUMPY"):
        (tmp_path / "x.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"x\.npz"):
            dataset_from_npz(tmp_path / "x.npz")
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("x.npy", b"no array")
    with pytest.raises(InputError, match=r"x\.npz"):
        dataset_from_npz(tmp_path / "x.npz")
    for path in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(InputError, match="cannot read"):
            dataset_from_npz(path)


def test_arrays_too_large_are_refused_unread(tmp_path: Path, driven: Dataset) -> None:
    """A small archive may unpack to more than there is memory."""
    path = save(tmp_path / "x.npz", driven)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bayesrace.learning.sources.MAX_BYTES", 1000)
        with pytest.raises(InputError, match="split it"):
            dataset_from_npz(path)


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_damaged_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, driven: Dataset, data: st.DataObject
) -> None:
    """Also inside compressed arrays."""
    path = tmp_path_factory.mktemp("npz") / "x.npz"
    write_npz(path, driven.select(slice(3)))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        dataset_from_npz(path)
    except InputError:
        return


# Logs --------------------------------------------------------------------------------------------


def test_a_log_names_its_car_and_discretisation(tmp_path: Path, driven: Dataset) -> None:
    facts = log_facts(write_log(tmp_path / "bare.mcap", driven))
    assert (facts.names, facts.car, facts.discretisation) == (("orca",), None, None)
    given = {"car": "orca", "discretisation": PREDICTION.model_dump()}
    race = {"race": {"settings": json.dumps(given)}}
    facts = log_facts(write_log(tmp_path / "race.mcap", driven, "red", race))
    assert (facts.names, facts.car, facts.discretisation) == (("red",), CAR, PREDICTION)


@pytest.mark.parametrize("content", ["{", "[1]", '{"discretisation": {"scheme": "magic"}}'])
def test_damaged_settings_in_a_log_are_refused(
    tmp_path: Path, driven: Dataset, content: str
) -> None:
    log = write_log(tmp_path / "a.mcap", driven, "orca", {"race": {"settings": content}})
    with pytest.raises(InputError, match=r"a\.mcap.*settings"):
        log_facts(log)


def test_logs_and_arrays_come_together_in_order(
    tmp_path: Path, driven: Dataset, other: Dataset
) -> None:
    """A step in single precision is the step that is meant."""
    paths = [write_log(tmp_path / "a.mcap", driven)]
    paths.append(save(tmp_path / "b.npz", other, step_s=np.float32(STEP_S)))
    samples = read_samples(paths)
    assert samples.discretisation == PREDICTION
    assert np.array_equal(samples.dataset.x, np.vstack((driven.x, other.x)))
    assert len(read_samples(paths[1:]).dataset) == len(other)


def test_a_damaged_file_is_reported_as_such(tmp_path: Path) -> None:
    """It does not name its car either, but that is not what is wrong with it."""
    (tmp_path / "x.npz").write_bytes(b"PK, and no more")
    with pytest.raises(InputError, match=r"x\.npz: not arrays"):
        read_samples([tmp_path / "x.npz"])


def test_the_plans_in_a_log_are_not_kept(tmp_path: Path, driven: Dataset) -> None:
    """A log of an hour holds gigabytes of them, as Python's numbers."""
    path, plan = write_log(tmp_path / "a.mcap", driven), (0.5,) * 147
    log = LogWriter(tmp_path / "b.mcap")
    for entry in LogReader(path).messages():
        log.write(entry.key, encode(entry.message), 1)
    for cycle in range(1000):
        fallback = int(cycle in (3, 4))
        message = replace(telemetry(0, cycle, fallback), plan_x=plan)
        log.write("bayesrace/orca/telemetry", encode(message), 1)
    log.close()
    tracemalloc.start()
    data = dataset_from_log(tmp_path / "b.mcap", CAR, STEP_S)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert dict(data.dropped) == {"fallback": 2}
    assert peak < 0.5 * 1000 * len(plan) * (8 + sys.getsizeof(0.5))


def test_a_car_under_another_name_is_known_by_its_log(
    tmp_path: Path, driven: Dataset, other: Dataset
) -> None:
    named = write_log(tmp_path / "a.mcap", driven, "red", {"drive": {"car": "orca"}})
    assert same(read_samples([named]).dataset, driven)
    unnamed = write_log(tmp_path / "b.mcap", other, "red")
    with pytest.raises(InputError, match="--car"):
        read_samples([unnamed])
    assert same(read_samples([unnamed], car=CAR).dataset, other)
    with pytest.raises(InputError, match="states of red, not of 'blue'"):
        read_samples([named], name="blue")


def test_mixed_cars_are_refused(tmp_path: Path, driven: Dataset, other: Dataset) -> None:
    a = write_log(tmp_path / "a.mcap", driven)
    lorry = CAR.model_copy(update={"name": "lorry"})
    about = {"drive": {"car": car_text(lorry)}}
    b = write_log(tmp_path / "b.mcap", other, "red", about)
    with pytest.raises(InputError, match=r"'orca-.*'lorry-"):
        read_samples([a, b])
    with pytest.raises(InputError, match="lorry"):
        read_samples([a], car=lorry)


def test_mixed_discretisations_and_steps_are_refused(
    tmp_path: Path, driven: Dataset, other: Dataset
) -> None:
    euler = Discretisation(scheme="euler", step_s=STEP_S)
    logs = [
        write_log(
            tmp_path / f"{number}.mcap",
            data,
            "orca",
            {"race": {"settings": json.dumps({"discretisation": used.model_dump()})}},
        )
        for number, (data, used) in enumerate(((driven, PREDICTION), (other, euler)))
    ]
    assert read_samples(logs[1:]).discretisation == euler
    with pytest.raises(InputError, match=r"euler.*1\.mcap"):
        read_samples(logs)
    with pytest.raises(InputError, match="discretisations"):
        read_samples(logs[:1], discretisation=euler)
    slow = save(tmp_path / "slow.npz", other, step_s=0.05)
    with pytest.raises(InputError, match=r"slow\.npz.*0\.05 s apart"):
        read_samples([logs[0], slow])
    with pytest.raises(InputError, match=r"0\.02 s apart, the model.s step is 0\.01 s"):
        dataset_from_log(logs[0], CAR, 0.01)


def test_the_same_samples_twice_are_refused(tmp_path: Path, driven: Dataset) -> None:
    """They would make the GP twice as sure as it may be."""
    log = write_log(tmp_path / "a.mcap", driven)
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(log.read_bytes())
    for second in (log, copy):
        with pytest.raises(InputError, match="same samples"):
            read_samples([log, second])


def test_nothing_given_is_refused() -> None:
    with pytest.raises(InputError, match="at least one log"):
        read_samples([])
