"""The compiled step and time: the plan keeps in step with it, and a budget is used and kept."""

from typing import Any

import numpy as np
import pytest

from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.errors import InputError
from tests.conftest import SETTINGS, Circuit, Make, Problem

TS = 0.02


def solve(step: NativeStep, p: Problem, **times: float) -> Status:
    return step.solve(p.x0, p.d_previous, p.reference, **times)


_CLOCKS: list["Clock"] = []


class Clock:
    """A host's clock on which every reading takes ``tick_s``."""

    def __init__(self, step: NativeStep, tick_s: float) -> None:
        self.now_s: float = 0.0
        self.tick_s = tick_s
        ffi = step.artefact.ffi
        self._callback = ffi.callback("br_mpc_clock", self._read)
        _CLOCKS.append(self)  # the library calls it as long as the controller is used
        error = step._library.br_mpc_set_clock(step.handle, self._callback, ffi.NULL)
        step._check(error, "clock")

    def _read(self, _: Any) -> float:
        self.now_s += self.tick_s
        return self.now_s


def residual(step: NativeStep) -> float:
    return float(max(step.info.stationarity, 0.1 * step.info.defect))


# --- the plan keeps in step --------------------------------------------------------------------


def test_one_stage_is_the_default_and_one_shift(make: Make, recorded: list[Problem]) -> None:
    explicit, implicit = make(), make()
    for k, p in enumerate(recorded[:40]):
        assert solve(explicit, p, elapsed_s=TS, budget_s=0.0) is solve(implicit, p)
        assert explicit.u.tobytes() == implicit.u.tobytes()
        assert explicit.info.shifts == (1 if k else -1)


@pytest.mark.parametrize(("elapsed_s", "every"), [(0.002, 10), (0.005, 4), (0.01, 2)])
def test_a_faster_loop_shifts_when_the_plan_lags_half_a_stage(
    make: Make, recorded: list[Problem], elapsed_s: float, every: int
) -> None:
    step, p, shifts = make(), recorded[30], []
    solve(step, p)
    for _ in range(10 * every):
        assert solve(step, p, elapsed_s=elapsed_s).usable
        shifts.append(step.info.shifts)
    at = np.flatnonzero(shifts)
    assert sum(shifts) == 10
    assert set(np.diff(at)) == {every}
    # half of the period from the first, but for rounding
    assert abs(at[0] + 1 - every / 2) <= 1


def test_a_missed_tick_shifts_twice_and_is_the_better_start(
    make: Make, recorded: list[Problem]
) -> None:
    used: dict[int, list[float]] = {1: [], 2: []}
    for k in range(20, 220, 10):
        exact = make(iterations=60, iterations_cold=60)
        solve(exact, recorded[k + 11])
        for shifts, error in used.items():
            step = make(iterations=2)
            for p in recorded[k : k + 10]:
                solve(step, p)
            assert solve(step, recorded[k + 11], elapsed_s=shifts * TS).usable
            assert step.info.shifts == shifts
            error.append(np.abs(step.read_plan()[1] - exact.read_plan()[1]).max())
    assert np.median(used[2]) < 0.5 * np.median(used[1])


def test_a_plan_older_than_the_horizon_is_forgotten(make: Make, recorded: list[Problem]) -> None:
    step, fresh = make(), make()
    solve(step, recorded[0])
    step.solve(np.full(7, np.nan), 0.0, recorded[0].reference, elapsed_s=15 * TS)
    assert solve(step, recorded[9], elapsed_s=6 * TS).usable
    assert step.info.shifts == -1
    solve(fresh, recorded[9])
    assert step.u.tobytes() == fresh.u.tobytes()


def test_time_goes_on_while_states_are_bad(make: Make, recorded: list[Problem]) -> None:
    step, skipped = make(), make()
    for one in (step, skipped):
        for p in recorded[:10]:
            solve(one, p)
    for _ in range(2):
        bad = step.solve(np.full(7, np.nan), 0.0, recorded[10].reference, elapsed_s=TS)
        assert bad is Status.BAD_STATE
    assert solve(step, recorded[12], elapsed_s=TS).usable
    assert step.info.shifts == 3
    solve(skipped, recorded[12], elapsed_s=3 * TS)
    assert step.u.tobytes() == skipped.u.tobytes()


@pytest.mark.parametrize("elapsed_s", [-1e-9, np.nan, np.inf])
def test_an_impossible_time_is_refused_and_not_counted(
    make: Make, recorded: list[Problem], elapsed_s: float
) -> None:
    step = make()
    solve(step, recorded[0])
    for call in (
        lambda: solve(step, recorded[1], elapsed_s=elapsed_s),
        lambda: step.prepare(elapsed_s),
    ):
        with pytest.raises(InputError, match="time is negative"):
            call()
    assert solve(step, recorded[1], elapsed_s=TS).usable
    assert step.info.shifts == 1


@pytest.mark.parametrize("ahead_m", [0.2, 0.7, 2.5])
def test_a_car_that_was_out_of_sight_is_found_on_the_line(
    native: NativeStep, circuit: Circuit, ahead_m: float
) -> None:
    """Also beyond the window in which a car that is seen every stage is looked for."""
    native.step(circuit.start(0.0, 2.0), 0.0)
    native.step(circuit.start(ahead_m, 2.0), 0.0, elapsed_s=ahead_m / 2.0)
    assert native.info.s_ref_m == pytest.approx(ahead_m, abs=0.02)


# --- the budget --------------------------------------------------------------------------------


def test_with_a_budget_the_step_iterates_until_it_converges(
    make: Make, recorded: list[Problem]
) -> None:
    step, converged = make(early_stop_tol=1e-7, tolerance=1e-12), 0
    Clock(step, 1e-6)
    for p in recorded[:60]:
        assert solve(step, p, budget_s=1.0).usable
        converged += residual(step) <= 1e-7
        assert step.info.time_limited == 0
        assert residual(step) <= 1e-7 or step.info.iterations >= SETTINGS.iterations_cold
    assert converged >= 55  # not where the Hessian is indefinite


@pytest.mark.parametrize("warm", [False, True])
def test_the_step_ends_within_its_budget(make: Make, recorded: list[Problem], warm: bool) -> None:
    """But for the first trial of all, which is always done and takes six readings, and for those
    after the last check: here they alone take time."""
    iterations, limited = set(), 0
    for readings in (2, 6, 8, 10, 13, 20, 30):
        step = make(early_stop_tol=1e-12, tolerance=1e-12)
        clock = Clock(step, 1e-3)
        for p in recorded[100:200:3]:
            if not warm:
                step.reset()
            begin_s = clock.now_s
            solve(step, p, budget_s=readings * 1e-3)
            assert clock.now_s - begin_s <= (max(readings, 6) + 4.5) * 1e-3
            limited += step.info.time_limited
            iterations.add(step.info.iterations)
    assert limited >= 40
    assert len(iterations) >= 4


def test_with_a_budget_the_best_iterate_is_returned(make: Make, recorded: list[Problem]) -> None:
    """Not the last: where the Hessian is indefinite, an iteration may make things worse."""
    worse = 0
    for p in recorded[::5]:
        iterates = []
        for iterations in range(1, 7):
            step = make(iterations_cold=iterations)
            if solve(step, p).usable and step.info.iterations == iterations:  # of the first guess
                iterates.append(residual(step))
        step = make(iterations_cold=6)
        Clock(step, 1e-3)
        assert solve(step, p, budget_s=1e3).usable
        assert residual(step) == min(iterates)
        worse += residual(step) < iterates[-1]
    assert worse >= 1


def test_the_first_iteration_is_always_done(make: Make, recorded: list[Problem]) -> None:
    hasty, plain = make(), make(iterations=1)
    Clock(hasty, 1.0)
    for one in (hasty, plain):
        for p in recorded[:30]:
            solve(one, p)
    assert solve(hasty, recorded[30], budget_s=1e-9) is solve(plain, recorded[30])
    assert hasty.u.tobytes() == plain.u.tobytes()
    assert (hasty.info.iterations, hasty.info.time_limited) == (1, 1)


@pytest.mark.parametrize(
    ("budget_s", "clock"), [(0.0, True), (-1.0, True), (np.nan, True), (1.0, False)]
)
def test_no_budget_or_clock_means_the_iteration_limits(
    make: Make, recorded: list[Problem], budget_s: float, clock: bool
) -> None:
    step, plain = make(iterations=3, early_stop_tol=1e-4), make(iterations=3, early_stop_tol=1e-4)
    Clock(step, 1e3)
    if not clock:
        null = step.artefact.ffi.NULL
        step._check(step._library.br_mpc_set_clock(step.handle, null, null), "clock")
    for p in recorded[:30]:
        assert solve(step, p, budget_s=budget_s) is solve(plain, p)
        assert step.u.tobytes() == plain.u.tobytes()


@pytest.mark.parametrize("tick_s", [np.nan, -1e-3])
def test_a_clock_that_is_broken_does_no_harm(
    make: Make, recorded: list[Problem], tick_s: float
) -> None:
    step = make()
    Clock(step, tick_s)
    usable = []
    for p in recorded[:20]:
        usable.append(solve(step, p, budget_s=1e-3).usable)
        assert 1 <= step.info.iterations <= 2 * SETTINGS.iterations_cold  # of a second start, too
        step.prepare(TS, 1e-3)
    assert all(usable[5:])


def test_out_of_time_goes_on_in_the_next_step_until_usable(
    make: Make, recorded: list[Problem]
) -> None:
    step = make(defect_max=1e-7)
    Clock(step, 1e-3)
    p = recorded[50]
    seen: list[Status] = []
    step.u[:] = 0.125
    while not seen or seen[-1] is Status.TIME_LIMIT:
        assert (step.u == 0.125).all()
        seen.append(solve(step, p, elapsed_s=0.0, budget_s=1e-3))
        assert step.info.shifts == (-1 if len(seen) == 1 else 0)
    assert 2 <= len(seen) <= 10
    assert seen[-1].usable


def test_a_plan_that_never_becomes_usable_is_given_up(make: Make, recorded: list[Problem]) -> None:
    step, p, cold = make(defect_max=1e-300, iterations_cold=6), recorded[50], []
    Clock(step, 1e-3)
    for _ in range(20):
        assert solve(step, p, elapsed_s=0.0, budget_s=1e-3) is Status.TIME_LIMIT
        cold.append(step.info.shifts == -1)
    assert list(np.flatnonzero(cold)) == [0, 6, 12, 18]


def test_more_iterations_do_not_take_back_a_usable_plan(
    make: Make, recorded: list[Problem]
) -> None:
    """Steps that lower the cost may raise the defect beyond what is usable."""
    for p in recorded[::10]:
        usable = False
        for iterations in range(1, 9):
            step = make(defect_max=3e-3, iterations_cold=iterations)
            status = solve(step, p)
            assert status.usable or not usable
            usable = status.usable
            if usable:
                assert step.info.defect <= 3e-3
                x, u = step.read_plan()
                v = np.column_stack([x[:-1], u])
                ends = np.array([step.evaluate(row, np.zeros(7))[0] for row in v])
                scale = np.array([1, 1, 1, 1, 1, 10, 1])
                gap = max(np.abs((ends - x[1:]) / scale).max(), np.abs(x[0] - p.x0).max())
                assert step.info.defect == pytest.approx(gap, rel=1e-9, abs=1e-13)


def test_the_systems_clock_runs(make: Make, recorded: list[Problem]) -> None:
    """NativeStep sets it: an hour limits nothing, a nanosecond everything."""
    step = make(early_stop_tol=1e-9)
    solve(step, recorded[0])
    assert solve(step, recorded[1], budget_s=3600.0).usable
    assert step.info.time_limited == 0
    assert step.info.iterations > 1
    solve(step, recorded[2], budget_s=1e-9)
    assert (step.info.time_limited, step.info.iterations) == (1, 1)


def test_every_status_has_the_librarys_text(native: NativeStep) -> None:
    known = sum(one < Status.DOUBTED for one in Status)
    numbers = (*range(known), known)
    texts = [native.artefact.text(native._library.br_mpc_status_text(i)) for i in numbers]
    assert len(set(texts)) == known + 1
    assert (texts[Status.BAD_STATE], texts[-1]) == ("bad state", "unknown status")


# --- QP steps are bounded, whatever the time ---------------------------------------------------


def test_all_qps_of_a_step_keep_to_their_number_of_steps(make: Make, circuit: Circuit) -> None:
    """A standing start askew of the line takes hundreds; cut off, the next step goes on, and ends
    where it does with more of them."""
    free, cut = make(qp_steps=1_000_000), make(qp_steps=200)
    x, y = circuit.table.rows[0, :2]
    hard = 0
    for heading in np.linspace(-1.2, 1.2, 9):
        state = np.array([x, y, np.pi / 2 + heading, 0.1, 0, 0, 0])
        for step in (free, cut):
            step.reset()
        assert free.step(state, 0.0) is not None
        hard += free.info.qp_iterations > 200
        for _ in range(60):
            status = cut.step(state, 0.0, elapsed_s=0.0)
            assert cut.info.qp_iterations <= 200
            assert status is not Status.TIME_LIMIT or cut.info.time_limited
            if status.usable:
                break
        else:
            pytest.fail("no usable plan")
        assert cut.info.defect <= SETTINGS.defect_max
    assert hard >= 2


def test_steps_that_do_not_reach_the_limit_do_not_know_of_it(
    make: Make, recorded: list[Problem]
) -> None:
    free, limited = make(qp_steps=1_000_000), make(qp_steps=400)
    for p in recorded[:60]:
        assert solve(free, p) is solve(limited, p)
        assert free.info.qp_iterations < 400
        assert free.u.tobytes() == limited.u.tobytes()
    with pytest.raises(InputError, match="out of its range"):
        limited.set_values({"qp_steps": 199})


# --- repeated by another clock ---


def test_another_step_is_out_of_time_where_one_was(make: Make, recorded: list[Problem]) -> None:
    """Whatever its clock says: so real-time drives are replayed to the bit."""
    one, two = make(defect_max=1e-7), make(defect_max=1e-7)
    hurried, patient = Clock(one, 1e-3), Clock(two, 0.0)
    refused = one.artefact.ffi.new("int[]", one.artefact.library.BR_REFUSALS)
    seen = set()
    for at in range(50, 70):
        p = recorded[at]
        for step in (one, two):
            solve(step, p, elapsed_s=0.02, budget_s=9.0 if step is two else 0.002 * (at % 9 + 1))
            assert step.info.time_limited == one.info.time_limited
            seen.add(step.info.time_limited)
            count = step._library.br_mpc_get_refusals(step.handle, refused)
            if step is one:
                two._library.br_mpc_repeat(two.handle, refused, count)
        assert (one.u == two.u).all()
        for step, budget_s in ((one, 0.002 * (at % 7 + 1)), (two, 9.0)):
            step.prepare(0.02, budget_s)
            if step is one:
                count = one._library.br_mpc_get_refusals(one.handle, refused)
                two._library.br_mpc_repeat(two.handle, refused, count)
    assert seen == {0, 1}
    assert hurried.now_s > patient.now_s == 0.0
