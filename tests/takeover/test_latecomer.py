"""Who joins late gets the newest accepted weights, whatever others answer, in whatever order."""

import itertools
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesrace.vehicles import get_car
from controller.gate.store import WITHDRAWN, Accepted, digest_of
from controller.latecomer import Latecomer, Tell, encode_answer, newest_first
from controller.ledger import Job, Ledger
from controller.native_step import NativeStep
from controller.takeover import Offer, WeightsPort

NOW_NS = 2_000_000_000 * 10**9
HOUR_NS = 3600 * 10**9
MOST_BYTES = 1000
FRESH = Accepted(0, "", b"", True)


def accepted(data: bytes, accepted_utc_ns: int, number: int = 1) -> Accepted:
    return Accepted(number, data.decode(), data, True, accepted_utc_ns)


def found(*answers: bytes) -> tuple[list[bytes], list[str]]:
    """Files, newest first, and why answers are ignored."""
    ones, ignored = newest_first(answers, MOST_BYTES, NOW_NS)
    return [one.data for one in ones], ignored


OLD = encode_answer(accepted(b"old, and longer than the others", 100), [])
MIDDLE = encode_answer(accepted(b"middle", 200), [])
NEW = encode_answer(accepted(b"new", 300), [])
UNDATED = encode_answer(accepted(b"from a store without times", 0), [])


def test_the_newest_comes_first_in_any_order() -> None:
    for answers in itertools.permutations([OLD, MIDDLE, NEW, UNDATED, b""]):
        files, ignored = found(*answers)
        assert files[:2] == [b"new", b"middle"]
        assert files[2:] == [b"old, and longer than the others", b"from a store without times"]
        assert ignored == []


def test_nobody_has_anything() -> None:
    assert found() == ([], [])
    assert found(b"", b"") == ([], [])
    assert encode_answer(replace(FRESH, data=b"given at the start"), []) == b""


def test_going_back_makes_old_weights_no_newer() -> None:
    """One controller has gone back to what it accepted first: others' newer ones count."""
    gone_back = encode_answer(accepted(b"old, and longer than the others", 100), [])
    for answers in itertools.permutations([gone_back, MIDDLE]):
        assert found(*answers)[0][0] == b"middle"


def test_what_somebody_has_given_up_is_taken_from_nobody() -> None:
    given_up = [digest_of(b"new")]
    gone_back = encode_answer(accepted(b"middle", 200), given_up)
    nothing_left = encode_answer(FRESH, given_up)
    for answers in itertools.permutations([NEW, gone_back, OLD]):
        assert found(*answers)[0] == [b"middle", b"old, and longer than the others"]
    for answers in itertools.permutations([NEW, nothing_left]):
        assert found(*answers) == ([], [])


def test_the_same_weights_are_as_old_as_their_first_acceptance() -> None:
    late = encode_answer(accepted(b"old, and longer than the others", 900), [])
    for answers in itertools.permutations([OLD, late, MIDDLE]):
        assert found(*answers)[0] == [b"middle", b"old, and longer than the others"]


def test_of_the_same_time_all_choose_the_same() -> None:
    answers = [encode_answer(accepted(bytes([65 + k]), 100), []) for k in range(4)]
    assert len({tuple(found(*order)[0]) for order in itertools.permutations(answers)}) == 1


MALFORMED = {
    "no answer of a controller": [b"x", b"BRACEGP\n" + bytes(200), NEW[:19], NEW[1:]],
    "layout 7 is not 1": [NEW[:8] + b"\7\0" + NEW[10:]],
    "are not the size": [
        encode_answer(accepted(b"y" * (MOST_BYTES + 1), 400), []),
        NEW[:10] + struct.pack("<H", 1) + NEW[12:],
        NEW[:10] + struct.pack("<H", WITHDRAWN + 1) + NEW[12:] + bytes(32 * WITHDRAWN + 32),
    ],
    "set the clocks": [
        encode_answer(accepted(b"z", NOW_NS + HOUR_NS + 1), []),
        encode_answer(accepted(b"z", -1), []),
    ],
}


@pytest.mark.parametrize("reason", MALFORMED)
def test_a_malformed_answer_is_ignored_and_the_others_count(reason: str) -> None:
    for bad in MALFORMED[reason]:
        for answers in itertools.permutations([OLD, bad, NEW]):
            files, ignored = found(*answers)
            assert files == [b"new", b"old, and longer than the others"]
            assert len(ignored) == 1
            assert reason in ignored[0]


@given(st.lists(st.binary(max_size=100) | st.binary(max_size=100).map(lambda b: NEW[:12] + b)))
def test_no_answer_raises(answers: list[bytes]) -> None:
    files, ignored = found(*answers)
    assert len(files) + len(ignored) <= len(answers)


def test_only_so_many_answers_are_read() -> None:
    files, ignored = found(*[OLD] * 32, NEW, NEW)
    assert files == [b"old, and longer than the others"]
    assert ignored == ["more than 32 answers"] * 2


def test_the_answer_names_the_newest_that_were_given_up() -> None:
    digests = [digest_of(bytes([k])) for k in range(WITHDRAWN + 5)]
    answers = [encode_answer(accepted(bytes([k]), k), []) for k in range(WITHDRAWN + 5)]
    files, _ = newest_first([encode_answer(FRESH, digests), *answers[:8]], MOST_BYTES, NOW_NS)
    assert [one.data for one in files] == [bytes([k]) for k in (4, 3, 2, 1, 0)]


@pytest.mark.parametrize("accepted_utc_ns", [0, 300, None])
def test_who_takes_them_over_makes_them_no_newer(accepted_utc_ns: int | None) -> None:
    """Not either where nobody knows when they were accepted; own ones are accepted now."""
    ledger = Ledger(WeightsPort(Path(), cast(NativeStep, None), get_car("orca"), [FRESH]))
    job = Job("weights", b"new", None, accepted_utc_ns=accepted_utc_ns)
    before_ns = time.time_ns()
    ledger.accept(Offer("new", 1, "weights", watched=True), job, 0.0)
    at_ns = ledger.newest.accepted_utc_ns
    if accepted_utc_ns is None:
        assert before_ns <= at_ns <= time.time_ns()
    else:
        assert at_ns == accepted_utc_ns


# Over time -----------------------------------------------------------------------------------


class Others:
    """What they answer, question by question, at the times of the test."""

    def __init__(self, *answers: Sequence[bytes] | None) -> None:
        """None: they are silent."""
        self._answers = list(answers)
        self._tell: Tell | None = None
        self.now_s = 100.0
        self.latecomer = Latecomer(self._ask, MOST_BYTES, needed=True, clock_s=lambda: self.now_s)

    def _ask(self, tell: Tell) -> None:
        answers = self._answers.pop(0)
        if answers is None:
            self._tell = tell
        else:
            tell(answers)

    def say(self, *answers: bytes) -> None:
        """After a silence."""
        assert self._tell is not None
        self._tell(answers)

    def after(self, seconds: float, in_use: Accepted, judged: bool = True) -> Callable[[], bytes]:
        """What is brought then, one by one; what was before it has a verdict, or has none."""
        self.now_s = 100.0 + seconds

        def bring() -> bytes:
            if judged:
                self.latecomer.judged()
            else:
                self.latecomer.put_back()
            one = self.latecomer.next(in_use)
            return b"" if one is None else one.data

        return bring


def test_it_asks_three_times_and_takes_what_is_newer() -> None:
    """A controller to which the connection takes longer may have newer weights."""
    others = Others([], [OLD, MIDDLE], [OLD, MIDDLE, NEW])
    assert others.after(0.1, FRESH)() == b""
    assert others.after(0.3, FRESH)() == b""
    in_use = accepted(b"middle", 200)
    assert others.after(1.1, FRESH)() == b"middle"
    assert others.after(1.2, in_use)() == b""
    assert others.after(3.1, in_use)() == b"new"
    assert others.after(3.2, accepted(b"new", 300))() == b""
    assert not others.latecomer.asking


def test_what_the_gate_refuses_is_followed_by_the_next() -> None:
    """And not brought again by the next question."""
    others = Others([OLD, NEW], [NEW, OLD], [NEW])
    bring = others.after(0.3, FRESH)
    assert [bring(), bring(), bring()] == [b"new", b"old, and longer than the others", b""]
    assert others.after(3.1, FRESH)() == b""
    assert others.latecomer.asking
    assert others.after(3.1, FRESH)() == b""
    assert not others.latecomer.asking


def test_what_had_no_verdict_is_brought_again_but_not_for_ever() -> None:
    """A gatekeeper that is killed says nothing about weights; one that dies of them, again and
    again, may."""
    others = Others([OLD, NEW], [OLD, NEW], [OLD, NEW])
    bring = others.after(0.3, FRESH, judged=False)
    assert [bring(), bring()] == [b"new"] * 2
    assert others.latecomer.put_back()
    assert others.latecomer.asking
    assert bring() == b"new"
    assert not others.latecomer.put_back()
    assert bring() == b"old, and longer than the others"
    assert others.after(3.1, FRESH)() == b""


def test_who_is_silent_is_not_waited_for() -> None:
    others = Others(None, None, [NEW])
    assert others.after(0.3, FRESH)() == b""
    assert others.after(1.1, FRESH)() == b""  # and not asked again meanwhile
    assert others.latecomer.asking
    others.say(OLD)
    assert others.after(1.2, FRESH)() == b"old, and longer than the others"
    in_use = accepted(b"old, and longer than the others", 100)
    assert others.after(1.3, in_use)() == b""
    others.latecomer.stop()
    others.say(NEW)
    assert others.after(9.0, in_use)() == b""


def test_who_is_told_what_to_drive_with_asks_no_more() -> None:
    others = Others([OLD, NEW])
    assert others.after(0.3, FRESH)() == b"new"
    others.latecomer.stop()
    assert not others.latecomer.asking
    assert others.after(9.0, FRESH)() == b""


def test_who_has_weights_does_not_ask() -> None:
    def ask(_: object) -> None:
        raise AssertionError("asked")

    latecomer = Latecomer(ask, MOST_BYTES, needed=False)
    assert not latecomer.asking
    assert latecomer.next(FRESH) is None


def test_what_is_ignored_is_counted_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    others = Others([b"x", b"y", OLD])
    assert others.after(0.3, FRESH)() == b"old, and longer than the others"
    assert others.latecomer.ignored == 2
    assert "ignored 2 answer(s) of other controllers: 1 bytes that are no answer" in caplog.text
