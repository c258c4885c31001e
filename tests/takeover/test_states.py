"""States in shared memory: read as they were recorded, or not at all."""

import pytest

from bayesrace.messages import State
from controller.weights.states import ALL, SharedStates

Pair = tuple[SharedStates, SharedStates]


def a_state(seq: int) -> State:
    return State(
        seq=seq,
        source_time_ns=0,
        epoch=2**62 - 1,
        run=3,
        time_s=0.02 * seq,
        x=(float(seq),) * 7,
        u_applied=(0.1, 0.2),
        lap=0,
        lockstep=True,
        actuation_delays=(),
        final=False,
    )


@pytest.fixture
def pair() -> Pair:
    """Both views of one memory."""
    writer = SharedStates()
    return writer, SharedStates(writer.fd)


def test_states_are_read_as_they_were_recorded(pair: Pair) -> None:
    writer, reader = pair
    for seq in range(5):
        writer.record(a_state(seq), None)
    found, after = reader.read(2)
    assert (after, reader.recorded) == (5, 5)
    assert [one.number for one in found] == [2, 3, 4]
    newest = a_state(4)
    assert (found[-1].epoch, found[-1].run, found[-1].seq) == (newest.epoch, newest.run, newest.seq)
    assert (found[-1].x, found[-1].u_applied) == (newest.x, newest.u_applied)
    assert found[-1].lockstep is True
    for fallen_back in (None, False, True):
        writer.record(a_state(5), fallen_back)
        assert reader.read(reader.recorded - 1)[0][0].fallen_back is fallen_back
    assert reader.read(8) == ([], 8)


def test_a_reader_far_behind_gets_what_is_still_there(pair: Pair) -> None:
    writer, reader = pair
    for seq in range(20_000):
        writer.record(a_state(seq), None)
    found, after = reader.read(0)
    assert after == 20_000
    assert [one.seq for one in found] == list(range(20_000 - len(found), 20_000))
    assert 8000 < len(found) < 8192


def test_a_state_that_is_being_written_is_not_read(pair: Pair) -> None:
    writer, reader = pair
    for seq in range(3):
        writer.record(a_state(seq), None)
    writer._map[64 + 128 + 50] ^= 1
    assert [one.seq for one in reader.read(0)[0]] == [0, 2]


def test_the_progress_of_the_watch_is_one_word(pair: Pair) -> None:
    writer, reader = pair
    for progress in ((0, 0, False), (3, 17, True), (2**20, ALL, False)):
        reader.report(*progress)
        assert writer.progress == progress
