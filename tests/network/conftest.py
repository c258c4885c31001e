"""Fixtures of the network tests."""

from collections.abc import Iterator

import pytest

from tests.network.hosts import Network, network, why_not_here


@pytest.fixture(scope="session")
def namespaces() -> None:
    """Skips where there can be no network namespaces."""
    if reason := why_not_here():
        pytest.skip(reason)


@pytest.fixture
def net(namespaces: None) -> Iterator[Network]:
    """Two hosts with a perfect link between them."""
    with network() as made:
        yield made
