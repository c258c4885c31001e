"""Sessions, publishers, the inbox and requests, over real loopback links within one process."""

import json
import re
import resource
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import pytest
import zenoh

from bayesrace.defaults import MAX_WEIGHTS_BYTES
from bayesrace.errors import InputError
from bayesrace.messages import (
    EVENT,
    ROLLBACK,
    RUN,
    STATE,
    STATUS,
    STOP,
    WEIGHTS,
    Role,
    RollbackRequest,
    Service,
    Status,
    StatusRequest,
    StopRequest,
    car_key,
    decode,
    encode,
)
from bayesrace.transport import (
    Director,
    Endpoints,
    Inbox,
    Item,
    Kind,
    Publisher,
    Request,
    ask,
    ask_all,
    declare_service,
    decode_request,
    free_endpoint,
    open_session,
    private_endpoints,
    send_weights,
)
from bayesrace.transport import inbox as inbox_module
from bayesrace.transport.links import Links
from bayesrace.transport.session import unlinked, zenoh_config
from tests import sample_messages as messages
from tests.command_line import Cli, refused
from tests.fake_processes import Fakes, fakes, status_of
from tests.programs import finish, run, start, until

__all__ = ["fakes"]

pytestmark = pytest.mark.wall_clock


@pytest.fixture
def pair() -> Iterator[tuple[Any, Any]]:
    """Two connected sessions."""
    endpoint = free_endpoint()
    with ExitStack() as stack:
        one = stack.enter_context(open_session(Endpoints(listen=(endpoint,))))
        two = stack.enter_context(open_session(Endpoints(connect=(endpoint,))))
        yield one, two


def take(inbox: Inbox, kind: Kind, timeout_s: float = 5.0) -> Item:
    deadline = time.monotonic() + timeout_s
    while (left := deadline - time.monotonic()) > 0:
        item = inbox.get(left)
        if item is not None and item.kind is kind:
            return item
    raise AssertionError(f"no {kind} within {timeout_s} s")


def _queues(inbox: Inbox, count: int) -> bool:
    return inbox.queued == count


def meet(one: Inbox, two: Inbox) -> None:
    """Each knows what the other has declared."""
    one.watch("controller")
    two.watch("plant")
    one.announce("plant")
    two.announce("controller")
    take(one, Kind.ALIVE)
    take(two, Kind.ALIVE)


def test_nothing_is_lost_or_reordered_in_lockstep(pair: tuple[Any, Any]) -> None:
    sender, receiver = Inbox(pair[0], "orca"), Inbox(pair[1], "orca")
    receiver.subscribe(STATE)
    meet(sender, receiver)
    publisher = Publisher(pair[0], STATE, "orca")
    for _ in range(3000):
        publisher.put(messages.state(publisher.next_seq), lockstep=True)
    for seq in range(3000):
        item = take(receiver, Kind.MESSAGE)
        assert item.name == "state"
        assert item.value == messages.state(seq)
    assert receiver.overflowed == 0


def test_an_inbox_receives_its_own_car_or_all_and_counts_what_its_queue_cannot_take(
    pair: tuple[Any, Any],
) -> None:
    sender, own, every = (
        Inbox(pair[0], "one"), Inbox(pair[1], "one"), Inbox(pair[1], None, capacity=3)
    )  # fmt: skip
    for inbox in (own, every):
        inbox.subscribe(STATE)
    meet(sender, own)
    for seq, car in enumerate(("two", "one", "two", "two")):
        Publisher(pair[0], STATE, car).put(messages.state(seq), lockstep=True)
    assert take(own, Kind.MESSAGE).value == messages.state(1)
    deadline = time.monotonic() + 5.0
    while not every.overflowed and time.monotonic() < deadline:
        time.sleep(0.01)
    keys = [take(every, Kind.MESSAGE).key for _ in range(3)]
    assert keys == [car_key(STATE.key, car) for car in ("two", "one", "two")]
    assert (every.overflowed, every.get()) == (1, None)


def test_every_request_that_shares_an_answer_ends_whatever_fails() -> None:
    """Its client waits for that, and it would keep its place."""
    queries = [Mock(payload=None) for _ in range(3)]
    queries[0].reply.side_effect = zenoh.ZError
    queries[1].reply.side_effect = RuntimeError
    first, *others = (Request(STATUS, query, None) for query in queries)
    assert all(first.join(other, 3) for other in others)
    with pytest.raises(RuntimeError):
        first.answer_raw(b"")
    assert [query.drop.call_count for query in queries] == [1, 1, 1]


def test_requests_are_answered_and_silence_is_an_error(pair: tuple[Any, Any]) -> None:
    server, client = Inbox(pair[0], "orca"), Inbox(pair[1], "orca")
    server.serve(STATUS, "plant")
    server.serve(WEIGHTS)
    server.serve(STOP)
    meet(server, client)
    status = messages.status(epoch=5, text="fine", rate_hz=50.0, counters={"late": 3})

    def answer() -> None:
        take(server, Kind.REQUEST).value.answer(status)
        request = take(server, Kind.REQUEST).value
        request.answer(messages.reply(True, f"{len(request.payload)} bytes"))
        request = take(server, Kind.REQUEST).value
        message, why_not = decode_request(request)
        assert (message, why_not) == (StopRequest(seq=0, source_time_ns=0, text="enough"), "")
        request.answer(messages.reply(False, "no"))
        request = take(server, Kind.REQUEST).value
        message, why_not = decode_request(request)
        assert message is None
        request.answer(messages.reply(False, why_not))

    thread = threading.Thread(target=answer)
    thread.start()
    session = pair[1]
    try:
        assert (
            ask(session, STATUS, "orca", StatusRequest(seq=0, source_time_ns=0), "plant") == status
        )
        # Larger than one batch of the transport: weights are.
        assert ask(session, WEIGHTS, "orca", bytes(300_000)).text == "300000 bytes"
        assert not ask(
            session, STOP, "orca", StopRequest(seq=0, source_time_ns=0, text="enough")
        ).accepted
        assert ask(session, STOP, "orca", b"junk").text.startswith("StopRequest: ")
    finally:
        thread.join()
    with pytest.raises(InputError, match="no answer on bayesrace/other/plant/status"):
        ask(session, STATUS, "other", StatusRequest(seq=0, source_time_ns=0), "plant")
    with pytest.raises(InputError, match=r"within 0\.1 s; .* wait longer \(--timeout\)"):
        ask(session, STOP, "other", StopRequest(seq=0, source_time_ns=0, text=""), timeout_s=0.1)


@contextmanager
def answering(pair: tuple[Any, Any], service: Service[Any, Any], *data: bytes) -> Iterator[None]:
    """The first answers are of the first session, the last one is of the second."""
    with ExitStack() as stack:
        for number, one in enumerate(data, 1):
            answer = partial(Request.answer_raw, data=one)
            session = pair[number == len(data)]
            stack.enter_context(declare_service(session, service, "orca", answer))
        inboxes = [Inbox(session, "orca") for session in pair]
        meet(*inboxes)
        yield


def test_of_several_under_one_name_a_refusal_is_the_answer(pair: tuple[Any, Any]) -> None:
    """All are heard, and a yes of one does not hide the no of another."""
    replies = [messages.reply(accepted) for accepted in (True, False, True)]
    request, key = StopRequest(seq=0, source_time_ns=0, text=""), car_key(STOP.key, "orca")
    encoded = [encode(one) for one in replies]
    with answering(pair, STOP, *encoded):
        for session in pair:
            answers = ask_all(session, STOP, (key, "bayesrace/absent"), request, 5.0)
            assert sorted(map(encode, answers[key].valid)) == sorted(encoded)
            assert answers["bayesrace/absent"].count == 0
            assert ask(session, STOP, "orca", request) == replies[1]


def test_a_malformed_answer_does_not_hide_the_valid_ones(pair: tuple[Any, Any]) -> None:
    request, reply = (
        StopRequest(seq=0, source_time_ns=0, text=""),
        messages.reply(True),
    )
    with answering(pair, STOP, b"junk", encode(reply), b"more junk"):
        assert ask(pair[1], STOP, "orca", request) == reply
    with (
        answering(pair, STOP, b"junk", b"more junk"),
        pytest.raises(InputError, match="Reply: "),
    ):
        ask(pair[1], STOP, "orca", request)


def test_several_processes_of_one_name_are_reported(pair: tuple[Any, Any]) -> None:
    """Their messages would be mixed, in the car and in the log."""
    director, inboxes = Director(pair[1], "orca"), [Inbox(session, "orca") for session in pair]
    for number, inbox in enumerate(inboxes, 1):
        director.check_alone()
        inbox.announce("controller")
        until(lambda: len(director.inbox.nodes("controller")) == number, "its token")  # noqa: B023
    with pytest.raises(InputError, match="2 processes are the controller of car 'orca'; end all"):
        director.check_alone()


def test_a_request_beyond_the_limit_is_rejected_as_busy(
    pair: tuple[Any, Any],
) -> None:
    server, client = Inbox(pair[0], "orca"), Inbox(pair[1], "orca")
    server.serve(STOP)
    meet(server, client)
    key, request = car_key(STOP.key, "orca"), encode(StopRequest(seq=0, source_time_ns=0, text=""))
    waiting = [pair[1].get(key, payload=request, timeout=10.0) for _ in range(16)]
    with pytest.raises(InputError, match=f"on {key}: busy: 16 requests are waiting; try again"):
        ask(pair[1], STOP, "orca", request)
    assert server.requests_rejected == 1
    for _ in waiting:
        take(server, Kind.REQUEST).value.answer(messages.reply(True))
    assert all(len(list(answers)) == 1 for answers in waiting)


def test_requests_for_the_status_share_one_place_and_one_answer(pair: tuple[Any, Any]) -> None:
    server, client = Inbox(pair[0], "orca"), Inbox(pair[1], "orca")
    server.serve(STATUS, "plant")
    server.serve(RUN)
    meet(server, client)
    key = car_key(STATUS.key, "orca", "plant")
    request = encode(StatusRequest(seq=0, source_time_ns=0))
    block = zenoh.CongestionControl.BLOCK
    waiting = [
        pair[1].get(key, payload=request, timeout=10.0, congestion_control=block)
        for _ in range(100)
    ]
    until(lambda: server.requests_rejected == 84, "more than may share an answer")
    shared = take(server, Kind.REQUEST).value
    later = pair[1].get(key, payload=request, timeout=10.0)
    shared.answer(messages.status(seq=1))
    take(server, Kind.REQUEST).value.answer(messages.status(seq=2))
    found = [decode(Status, one.ok.payload.to_bytes()).seq for one in later]
    assert found == [2]
    assert sum(one.ok is not None for answers in waiting for one in answers) == 16


def test_a_run_and_its_stop_are_taken_before_requests_that_wait_for_longer(
    pair: tuple[Any, Any],
) -> None:
    server, client = Inbox(pair[0], "orca"), Inbox(pair[1], "orca")
    services: tuple[Service[Any, Any], ...] = ROLLBACK, RUN, STOP
    for service in services:
        server.serve(service)
    meet(server, client)
    block = zenoh.CongestionControl.BLOCK
    key = car_key(ROLLBACK.key, "orca")
    others = [pair[1].get(key, timeout=10.0, congestion_control=block) for _ in range(20)]
    until(lambda: server.requests_rejected == 4, "all places of other requests to be taken")
    urgent = []
    for number, service in enumerate(services[1:], 17):
        urgent.append(pair[1].get(car_key(service.key, "orca"), timeout=10.0))
        until(partial(_queues, server, number), service.name)
    names = []
    for _ in range(18):
        item = take(server, Kind.REQUEST)
        names.append(item.name)
        item.value.answer(messages.reply(True))
    assert names == ["run", "stop"] + 16 * ["rollback"]
    assert all(len(list(one)) == 1 for one in urgent)
    assert sum(one.ok is not None for answers in others for one in answers) == 16


def test_a_lost_request_is_repeated_but_for_a_rollback(pair: tuple[Any, Any]) -> None:
    """As when a link breaks because a machine stalls."""
    asker, answerer = pair
    heard: list[str] = []

    def answer(request: Request) -> None:
        heard.append(request.service.name)
        if len(heard) % 2:
            threading.Timer(0.8, request._queries[0].drop).start()
        else:
            request.answer(messages.reply(True, "yes"))

    _kept = [declare_service(answerer, one, "orca", answer) for one in (WEIGHTS, ROLLBACK)]
    time.sleep(0.5)  # the declarations travel
    assert ask(asker, WEIGHTS, "orca", b"weights").text == "yes"
    assert heard == ["weights", "weights"]
    with pytest.raises(InputError, match="no answer"):
        ask(asker, ROLLBACK, "orca", RollbackRequest(seq=0, source_time_ns=0, text=""))
    assert heard == ["weights", "weights", "rollback"]


def test_a_session_connects_when_its_peer_appears_and_sees_its_liveliness() -> None:
    endpoint = free_endpoint()
    with open_session(Endpoints(connect=(endpoint,))) as session:
        inbox = Inbox(session, "orca")
        inbox.watch("plant")
        assert inbox.get(0.3) is None
        with open_session(Endpoints(listen=(endpoint,))) as other:
            theirs = Inbox(other, "orca")
            theirs.announce("plant")
            assert take(inbox, Kind.ALIVE).name == "plant"
            assert inbox.alive == {"plant"}
        assert take(inbox, Kind.GONE).name == "plant"
        assert inbox.alive == set()


def test_weights_of_the_largest_size_arrive(pair: tuple[Any, Any]) -> None:
    """A session that reassembled less would drop them silently."""
    one, two = pair

    def on_request(request: Request) -> None:
        request.reply(True, "", {"size": len(request.payload)})

    service = declare_service(one, WEIGHTS, "orca", on_request)
    meet(*(Inbox(session, "orca") for session in pair))
    reply = send_weights(two, "orca", bytes(MAX_WEIGHTS_BYTES), timeout_s=10.0)
    service.undeclare()
    assert reply.data["size"] == MAX_WEIGHTS_BYTES


def test_an_absent_peer_is_an_error_that_says_what_to_do() -> None:
    with open_session(Endpoints(connect=(free_endpoint(),))) as session:
        director = Director(session, "orca")
        with pytest.raises(InputError, match="no controller and no plant for car 'orca' within"):
            director.wait_for(("plant", "controller"), 0.2)


def test_a_taken_port_is_an_error_that_says_what_to_do() -> None:
    endpoint = free_endpoint()
    with (
        open_session(Endpoints(listen=(endpoint,))),
        pytest.raises(InputError, match=f"cannot listen on {endpoint}: Address already in use"),
        open_session(Endpoints(listen=(endpoint,))),
    ):
        pass


def test_what_comes_late_over_a_closed_session_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such as the end of a process's token while the next session has it again."""
    monkeypatch.setattr(inbox_module, "in_transport_thread", lambda handler: handler)
    old, new = MagicMock(), MagicMock()
    inbox = Inbox(old, "orca")
    inbox.watch("plant")

    def token(session: MagicMock, kind: zenoh.SampleKind) -> None:
        handler = session.liveliness().declare_subscriber.call_args.args[1]
        handler(SimpleNamespace(key_expr="bayesrace/orca/alive/plant/1", kind=kind))

    token(old, zenoh.SampleKind.PUT)  # not taken from the queue before the next session is there
    inbox.bind(new)
    token(new, zenoh.SampleKind.PUT)
    token(old, zenoh.SampleKind.DELETE)
    assert inbox.nodes("plant") == {"1"}
    items = [inbox.get() for _ in range(4)]
    assert [one and one.kind for one in items] == [Kind.ALIVE, Kind.GONE, Kind.ALIVE, None]
    assert inbox.alive == {"plant"}


def test_a_link_made_with_the_last_descriptor_ends_no_process() -> None:
    """A flood of connections leaves none to look at the process's sockets with."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, before[1]))
    try:
        Links(None).tend()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.parametrize(
    "endpoint",
    ["", "localhost", "tcp/localhost", "tcp/localhost:70000", "ftp/x:1", "tcp/ a:1", "tcp/a..b:1"],
)
def test_a_malformed_endpoint_is_refused_by_name(endpoint: str) -> None:
    with pytest.raises(InputError, match="endpoint"), open_session(Endpoints(connect=(endpoint,))):
        pass


@pytest.mark.parametrize("peers_follow", [True, False])
def test_opening_a_session_waits_only_for_peers_that_may_be_there(peers_follow: bool) -> None:
    config = zenoh_config(Endpoints(), "viewer", peers_follow=peers_follow)
    waits = json.loads(config.get_json("open/return_conditions/connect_scouted"))
    assert waits is not peers_follow


def test_each_unix_socket_is_a_link_of_its_own() -> None:
    with (
        private_endpoints("here", "nowhere") as ends,
        open_session(Endpoints(listen=(ends[0],))),
        open_session(wanted := Endpoints(connect=tuple(ends)), peers_follow=True) as session,
    ):
        until(lambda: unlinked(session, wanted) == ends[1:], "the link")


def test_an_inbox_takes_several_topics_each_with_its_own_depth_and_decoder(
    pair: tuple[Any, Any],
) -> None:
    """A flood of one topic neither delays another nor costs it a message; refusals are counted."""
    sender, receiver = Inbox(pair[0], "orca"), Inbox(pair[1], "orca")
    states, events = (receiver.subscribe(STATE, newest=10), receiver.subscribe(EVENT, newest=1000))
    meet(sender, receiver)
    publishers = Publisher(pair[0], STATE, "orca"), Publisher(pair[0], EVENT, "orca", "plant")
    for seq in range(100):
        publishers[0].put(messages.state(seq), lockstep=True)
        publishers[1].put(messages.event(seq), lockstep=True)
    pair[0].put(car_key(EVENT.key, "orca", "race"), b"junk")  # events of all sources arrive
    time.sleep(0.5)  # all of it arrives
    found: dict[str, list[Any]] = {"state": [], "event": []}
    while None not in found["event"]:  # the refused one is the last
        item = take(receiver, Kind.MESSAGE)
        found[item.name].append(item.value)
    assert [one.seq for one in found["state"]] == list(range(90, 100))
    assert [one.seq for one in found["event"][:-1]] == list(range(100))
    assert (states.accepted, events.accepted, events.refused) == (10, 100, 1)
    for number in range(100):
        receiver.put(Item(Kind.SIGNAL, "", number, 0))
    publishers[0].put(messages.state(99), lockstep=True)
    time.sleep(0.5)
    kinds = [item.kind for item in (receiver.get(), receiver.get()) if item is not None]
    assert kinds == [Kind.SIGNAL, Kind.MESSAGE]  # the queue does not go first until it is empty
    while receiver.queued:
        take(receiver, Kind.SIGNAL)
    with receiver.stamped():
        publishers[0].put(messages.state(100), lockstep=True)
        publishers[1].put(messages.event(100), lockstep=True)
        assert {take(receiver, Kind.MESSAGE).name for _ in range(2)} == {"state", "event"}


@pytest.mark.skipif(
    not Path("/proc/self/sched").exists() or "se.slice" not in Path("/proc/self/sched").read_text(),
    reason="this kernel does not tell slices: before Linux 6.12, or not Linux",
)
def test_threads_of_the_transport_have_shorter_slices_than_their_owner(
    pair: tuple[Any, Any],
) -> None:
    """So that a message that wakes them does not wait for the thread that computes."""

    def slice_ns(task: Path) -> int:
        return int(re.findall(r"se\.slice\D*(\d+)", (task / "sched").read_text())[0])

    sender, receiver = Inbox(pair[0], "orca"), Inbox(pair[1], "orca")
    receiver.subscribe(STATE)
    meet(sender, receiver)
    Publisher(pair[0], STATE, "orca").put(messages.state(0), lockstep=True)
    take(receiver, Kind.MESSAGE)
    owner = Path(f"/proc/self/task/{threading.get_native_id()}")
    names = {task: (task / "comm").read_text()[:3] for task in owner.parent.iterdir()}
    transport = {task: name for task, name in names.items() if name in ("app", "net", "rx-", "tx-")}
    assert {"net", "rx-"} <= set(transport.values())
    assert max(map(slice_ns, transport)) < slice_ns(owner)


def test_a_peer_that_polls_sleeps_while_no_answer_can_be_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In simulated time, so that no stall of the machine matters: a look takes 1 us, a
    sleep 60 us more than it should."""
    now_s, looks, due_s = 0.0, 0, 0.0

    def sleep(duration_s: float) -> None:
        nonlocal now_s
        now_s += duration_s + 60e-6

    def look() -> Any:
        nonlocal now_s, looks
        now_s, looks = now_s + 1e-6, looks + 1
        return sample if now_s >= due_s else None

    clock = SimpleNamespace(
        monotonic=lambda: now_s, monotonic_ns=lambda: round(1e9 * now_s), sleep=sleep
    )
    monkeypatch.setattr(inbox_module, "clock", clock)
    sample = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: encode(messages.state())))
    session = MagicMock()
    session.declare_subscriber().handler.try_recv = look
    box = Inbox(session, "car")
    box.subscribe(STATE, newest=1)
    box.spin_s = 0.002

    def late_s(answer_s: float) -> float:
        """After an answer that takes so long: how much later it is noticed."""
        nonlocal due_s
        due_s = now_s + answer_s
        assert box.get(0.1) is not None
        return now_s - due_s

    for _ in range(300):  # learns how long an answer takes
        assert late_s(500e-6) < 5e-6
    looks = 0
    late_s(500e-6)
    assert looks < 60  # it would be 500 without a sleep
    late = [late_s(200e-6) for _ in range(40)]  # answers become faster than the sleep is long
    assert max(late) < 400e-6
    assert late[-1] < 5e-6


# Routers -----------------------------------------------------------------------------------------


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
