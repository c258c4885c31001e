"""``validate``, ``publish``, ``rollback``, ``learn``: validation and update of weights."""

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.files import write_whole
from operation.cli.configured import connect_to
from operation.cli.options import (
    AllSamples,
    Car,
    CarName,
    Endpoint,
    Seed,
    writable,
)
from operation.terminal.notation import UNCERTAIN

if TYPE_CHECKING:
    from bayesrace.transport import Endpoints

__all__ = ["learn", "publish", "rollback", "validate"]

Name = Annotated[
    str,
    typer.Option(
        "--name",
        "--car",
        metavar="NAME",
        show_default="the only one that is found",
        help="Name of the car.",
    ),
]
Timeout = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=0.1,
        max=600.0,
        show_default="5 and 20",
        help="Time limit [s], once for finding the controller and once for its answer.",
    ),
]
WeightsFile = Annotated[
    Path,
    typer.Argument(metavar="WEIGHTS", help="Weights file, as 'bayesrace train' writes it."),
]
_FINDING_S, _ANSWER_S = 5.0, 20.0


def validate(
    weights: WeightsFile,
    on: Annotated[
        list[Path],
        typer.Option("--on", metavar="FILE", help="Run log (MCAP) or arrays (.npz); repeatable."),
    ],
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json", metavar="FILE", callback=writable, help="Write the numbers to this file."
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", callback=writable, help="Draw the error with its 95 % band (PNG)."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Folder for numbers, error.png and track.png."
        ),
    ] = None,
    track: Annotated[
        str | None,
        typer.Option(
            metavar="TRACK",
            help="Track for track.png: name, random:SEED, random10:SEED or CSV file.",
        ),
    ] = None,
    threshold: Annotated[
        float,
        typer.Option(metavar="SIGMA", min=0, help="Mark samples whose largest sigma is above."),
    ] = UNCERTAIN,
    run: Annotated[
        list[int] | None,
        typer.Option(metavar="N", help="Only this run of the log; repeatable."),
    ] = None,
    car: Annotated[
        str,
        typer.Option(metavar="CAR", help="TOML file of the weights' car if it is not built in."),
    ] = "",
    name: CarName = "",
    all_samples: AllSamples = False,
) -> None:
    """Validate weights on a drive: error, coverage, and drift over one step and the horizon.

    Use drives that the weights were not trained on. The filters of the training apply here, too;
    --all-samples keeps samples beyond the car's limits.
    """

    from bayesrace.gp.weights import read_weights
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car
    from operation.analysis.validation import validate_weights
    from operation.terminal.learning_table import print_validation
    from operation.terminal.terminal import Terminal

    parameters = get_car(car) if car else None
    course = None if track is None else load_track(track)
    runs = tuple(run) if run else None
    judged = validate_weights(
        read_weights(weights), on, name, runs, threshold, parameters, limits=not all_samples
    )
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    text = judged.result.model_dump_json(indent=1) + "\n"
    for path in (json_file, out and out / "validation.json"):
        if path is not None:
            write_whole(path, text)
    if plot is not None or out is not None:
        from operation.report.canvas import write_png
        from operation.report.gp import band_figure, track_figure
        from operation.report.style import figure_style

        with figure_style():
            bands = band_figure(judged.validation, judged.dataset.step_s, threshold)
            for path in (plot, out and out / "error.png"):
                if path is not None:
                    write_png(bands, path)
            if out is not None:
                driven = track_figure(judged.dataset, judged.validation, threshold, course)
                write_png(driven, out / "track.png")
    print_validation(judged.result, Terminal())


def publish(
    weights: WeightsFile,
    name: Name = "",
    endpoint: Endpoint = None,
    timeout: Timeout = None,
) -> None:
    """Send new weights to a running controller, and wait for its answer.

    Exit code 0 once it drives with them, 1 if it refuses them (the message says if a later attempt
    can succeed), 2 if it cannot be reached.
    """
    from bayesrace.gp.weights import encode_weights, read_weights
    from bayesrace.transport import open_session, send_weights

    data = encode_weights(read_weights(weights))
    endpoints = connect_to(endpoint, "learning")
    name = endpoints.car_named(name)
    with open_session(endpoints, "learning") as session:
        # Imports that take as long as all before: whether there is a link is said first.
        from operation.learn.publishing import NotTakenOverError, in_words

        car = _controller(session, endpoints, name, timeout or _FINDING_S)
        reply = send_weights(session, car, data, timeout or _ANSWER_S)
    if not reply.accepted:
        raise NotTakenOverError(f"{car}: {in_words(reply)}")
    typer.echo(f"{car}: {reply.data.get('version', '')} {in_words(reply)}")


def rollback(
    name: Name = "",
    endpoint: Endpoint = None,
    reason: Annotated[
        str, typer.Option(metavar="TEXT", help="Reason, for the controller's event.")
    ] = "",
    timeout: Timeout = None,
) -> None:
    """Let a controller return to the weights before those in use.

    Exit code 0 once it drives with them, 1 if there are none, 2 if it cannot be reached.
    """
    from bayesrace.transport import open_session, send_rollback

    endpoints = connect_to(endpoint, "learning")
    name = endpoints.car_named(name)
    with open_session(endpoints, "learning") as session:
        from operation.learn.publishing import NotTakenOverError, in_words

        car = _controller(session, endpoints, name, timeout or _FINDING_S)
        reply = send_rollback(session, car, reason or "bayesrace rollback", timeout or _ANSWER_S)
    if not reply.accepted:
        raise NotTakenOverError(f"{car}: {in_words(reply)}")
    before = reply.data.get("from_version")
    instead = f", instead of {before}" if before else ""
    typer.echo(f"{car}: {reply.data.get('version', '')} {in_words(reply)}{instead}")


def learn(
    watch: Annotated[
        bool, typer.Option("--watch", help="Learn after each lap until Ctrl-C, not after one lap.")
    ] = False,
    laps: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="End after so many laps.")
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="First samples: log (MCAP) or arrays (.npz); repeatable."
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="First weights, which are sent to the controller."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            show_default="runs/learn-DATE-TIME",
            help="Folder for results, or of a job to resume (--data and --weights do not count "
            "then).",
        ),
    ] = None,
    points: Annotated[
        int, typer.Option(metavar="N", min=20, max=20000, help="Points per output.")
    ] = 400,
    keep: Annotated[
        int,
        typer.Option(metavar="N", min=100, max=20000, help="Samples kept from lap to lap."),
    ] = 1200,
    track: Annotated[
        str | None,
        typer.Option(
            metavar="TRACK",
            help="Track that is driven: for exact lap times and excursions.",
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Run directory of a race, to draw its lap times, too."),
    ] = None,
    artefact: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", show_default="the default one", help="Built controller to learn for."
        ),
    ] = None,
    endpoint: Endpoint = None,
    seed: Seed = 0,
    car: Car = DEFAULT_CAR,
    name: CarName = "",
) -> None:
    """Learn from the laps of a driving car, and send the weights to its controller.

    After each lap a background process trains on the samples that were kept and on the new ones,
    and publishes the weights. Plant and controller may start before or after this command, and
    restart; with the same --out, this command resumes. Start a run with 'bayesrace drive'.
    """
    from bayesrace.transport import try_links
    from bayesrace.vehicles import get_car

    parameters, endpoints = get_car(car), connect_to(endpoint, "learning")
    endpoints.check_car(name or parameters.name)
    try_links(endpoints, "learning")  # before imports that take seconds
    from operation.learn.job import learn as follow
    from operation.learn.records import LearnSettings
    from operation.learn.report import print_laps

    stamp = datetime.now(UTC).astimezone().strftime("%Y%m%d-%H%M%S")
    folder = out or Path("runs") / f"learn-{stamp}"
    settings = LearnSettings(
        car=parameters,
        name=name or parameters.name,
        points=points,
        keep=keep,
        laps=laps or (None if watch else 1),
        track=track,
        compare=compare,
        seed=seed,
    )
    record = follow(
        settings, endpoints, folder, typer.echo,
        data=data or (), weights=weights, artefact=artefact,
    )  # fmt: skip
    print_laps(record)
    typer.echo(str(folder))


def _controller(session: object, endpoints: "Endpoints", name: str, timeout_s: float) -> str:
    """The car of the controller to send to; InputError if none or several are found."""
    from operation.lifecycle import find, pick

    found = find(session, endpoints, timeout_s, name, ("controller",))
    return pick(found, name, False)[0]
