"""The router: it forwards between all that know only it, and peers do not."""

import signal
from contextlib import ExitStack

import pytest

from bayesrace.messages import STATE, Role
from bayesrace.transport import Endpoints, Inbox, Kind, Publisher, free_endpoint, open_session
from tests import sample_messages as messages
from tests.command_line import Cli, refused
from tests.fake_processes import Fakes, fakes, status_of
from tests.programs import finish, run, start, until
from tests.test_transport import take

__all__ = ["fakes"]

pytestmark = pytest.mark.wall_clock


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_router_forwards_between_plant_controller_and_observer_and_a_peer_does_not(
    mode: str,
) -> None:
    """Tokens, messages and requests: all that know only the router."""
    endpoint = free_endpoint()
    middle = Endpoints.model_validate({"listen": (endpoint,), "mode": mode})
    roles: tuple[Role, ...] = ("plant", "controller", "viewer")
    with ExitStack() as stack:
        stack.enter_context(open_session(middle))
        plant, controller, observer = (
            stack.enter_context(open_session(Endpoints(connect=(endpoint,)), role))
            for role in roles
        )
        theirs = Inbox(plant, "a")
        theirs.announce("plant")
        receivers = [Inbox(controller, "a"), Inbox(observer, "a")]
        for inbox in receivers:
            inbox.subscribe(STATE)
            inbox.watch("plant")
        if mode == "peer":
            assert [inbox.get(0.5) for inbox in receivers] == [None, None]
            return
        receivers[0].announce("controller")
        theirs.watch("controller")
        for inbox in (theirs, *receivers):
            take(inbox, Kind.ALIVE)
        Publisher(plant, STATE, "a").put(messages.state(0), lockstep=True)
        for inbox in receivers:
            take(inbox, Kind.MESSAGE)


@pytest.mark.check
def test_the_router_command_forwards_and_ends_on_sigterm(fakes: Fakes) -> None:
    endpoint = free_endpoint()
    router = start("router", "--listen", endpoint)
    through = Endpoints(connect=(endpoint,))
    try:
        fakes("a", "plant", endpoints=through)
        two = fakes("a", "controller", endpoints=through)

        def both_answer() -> bool:
            """The router hears of one before it hears of the other."""
            content = status_of(through, "a", patience_s=60.0).as_json()["cars"]["a"]
            return all(one is not None and one["answering"] for one in content.values())

        until(both_answer, "answers of both through the router")
        assert run("stop", "--endpoint", endpoint).returncode == 0
        assert [one.command for one in two.heard] == ["stop"]
    finally:
        router.send_signal(signal.SIGTERM)
        done = finish(router)
    assert done.returncode == 0
    assert done.stderr == f"bayesrace.router: router on {endpoint}\n"


def test_a_router_that_cannot_listen_says_so(cli: Cli) -> None:
    refused(cli("router", "--listen", "tcp/localhost"), "is not of the form protocol/address:port")
