"""Fixtures of the tests with real processes."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.gp.weights import Weights, read_weights
from bayesrace.vehicles import Car
from tests.conftest import fit_weights
from tests.network.cars import Course
from tests.takeover.rig import KINDS, Rig, make_course, rigged


@pytest.fixture(scope="session")
def course(tmp_path_factory: pytest.TempPathFactory) -> Course:
    """What is driven on."""
    return make_course(tmp_path_factory.mktemp("course"))


@pytest.fixture(scope="session")
def good(course: Course) -> Weights:
    """What the controllers are started with."""
    return read_weights(course.weights_file)


@pytest.fixture(scope="session")
def again(car: Car) -> Weights:
    """As good, learned from another drive."""
    return replace(fit_weights(car, KINDS, count=300, seed=2), version="again")


@pytest.fixture
def rig(tmp_path: Path, course: Course) -> Iterator[Rig]:
    """Plant and controller, on the course."""
    with rigged(tmp_path, course) as made:
        yield made
