"""``validate``, ``publish``, ``rollback``, ``learn``: weights judged, sent, made lap by lap."""

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesrace.files import write_whole
from bayesrace.vehicles import DEFAULT_CAR
from experiments.cli.options import Car, CarName, Endpoint, Seed, connect_to, writable
from experiments.notation import UNCERTAIN

if TYPE_CHECKING:
    from bayesrace.transport import Endpoints

__all__ = ["register"]

Name = Annotated[
    str, typer.Option("--name", "--car", help="Name of the car; the only one there is without.")
]
Timeout = Annotated[
    float,
    typer.Option(min=0.1, max=600.0, help="Seconds to find the controller, and again to answer."),
]
_TIMEOUT_S = 20.0


def validate(
    weights: Annotated[Path, typer.Argument(help="Weights file, as 'bayesrace train' writes it.")],
    on: Annotated[
        list[Path], typer.Option("--on", help="Run log (MCAP) or arrays (.npz); repeatable.")
    ],
    json_file: Annotated[
        Path | None,
        typer.Option("--json", callback=writable, help="Write the numbers to this file."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(callback=writable, help="Error with its 95 % band, as a picture (PNG)."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for all: numbers, error.png, track.png."),
    ] = None,
    track: Annotated[
        str | None, typer.Option(help="Track to draw the drive on: name, random:SEED or CSV file.")
    ] = None,
    threshold: Annotated[
        float, typer.Option(min=0, help="Mark where the largest sigma is above this.")
    ] = UNCERTAIN,
    run: Annotated[
        list[int] | None, typer.Option(help="Only this run of the log; repeatable.")
    ] = None,
    car: Annotated[
        str, typer.Option(help="Car of the weights, where it is not built in: TOML file.")
    ] = "",
    name: CarName = "",
) -> None:
    """Judge weights on a drive: error, coverage, and drift over one step and over the horizon.

    Compare drives that the weights have not seen. Samples that training would leave out are left
    out here too.
    """

    from bayesrace.gp.weights import read_weights
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car
    from experiments.learning_table import print_validation
    from experiments.terminal import Terminal
    from experiments.validation import validate_weights

    parameters = get_car(car) if car else None
    course = None if track is None else load_track(track)
    runs = tuple(run) if run else None
    judged = validate_weights(read_weights(weights), on, name, runs, threshold, parameters)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    text = judged.result.model_dump_json(indent=1) + "\n"
    for path in (json_file, out and out / "validation.json"):
        if path is not None:
            write_whole(path, text)
    if plot is not None or out is not None:
        from experiments.report.canvas import write_png
        from experiments.report.style import figure_style
        from experiments.report.validation import band_figure, track_figure

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
    weights: Annotated[Path, typer.Argument(help="Weights file, as 'bayesrace train' writes it.")],
    name: Name = "",
    endpoint: Endpoint = None,
    timeout: Timeout = _TIMEOUT_S,
) -> None:
    """Hand new weights to a running controller, and wait for its answer.

    Exit code 0 once it drives with them, 1 if it refuses (and says so if only for now), 2 if it
    cannot be asked.
    """
    from bayesrace.files import read_whole
    from bayesrace.gp.weights import MAX_BYTES
    from bayesrace.transport import open_session, send_weights
    from experiments.learn.publishing import NotTakenOverError, in_words

    data = read_whole(weights, "weights file", MAX_BYTES)
    endpoints = connect_to(endpoint)
    with open_session(endpoints) as session:
        car = _controller(session, endpoints, name, timeout)
        reply = send_weights(session, car, data, timeout)
    if not reply.accepted:
        raise NotTakenOverError(f"{car}: {in_words(reply)}")
    typer.echo(f"{car}: {reply.data.get('version', '')} {in_words(reply)}")


def rollback(
    name: Name = "",
    endpoint: Endpoint = None,
    reason: Annotated[str, typer.Option(help="Why; it shows in the controller's event.")] = "",
    timeout: Timeout = _TIMEOUT_S,
) -> None:
    """Have a controller return to the weights before those that it drives with.

    Exit code 0 once it drives with them, 1 if there are none, 2 if it cannot be asked.
    """
    from bayesrace.transport import open_session, send_rollback
    from experiments.learn.publishing import NotTakenOverError, in_words

    endpoints = connect_to(endpoint)
    with open_session(endpoints) as session:
        car = _controller(session, endpoints, name, timeout)
        reply = send_rollback(session, car, reason or "bayesrace rollback", timeout)
    if not reply.accepted:
        raise NotTakenOverError(f"{car}: {in_words(reply)}")
    before = reply.data.get("from_version")
    instead = f", instead of {before}" if before else ""
    typer.echo(f"{car}: {reply.data.get('version', '')} {in_words(reply)}{instead}")


def learn(
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on, lap by lap, until Ctrl-C; else one lap.")
    ] = False,
    laps: Annotated[int | None, typer.Option(min=1, help="End after so many laps.")] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Samples to begin with: log (MCAP) or arrays (.npz); repeatable."),
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Weights to begin with; the controller is given them.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder to leave, or to go on in, then without reading --data and --weights "
            "[runs/learn-DATE-TIME].",
        ),
    ] = None,
    points: Annotated[int, typer.Option(min=20, max=20000, help="Points per output.")] = 400,
    keep: Annotated[
        int, typer.Option(min=100, max=20000, help="Samples kept from lap to lap.")
    ] = 1200,
    track: Annotated[
        str | None,
        typer.Option(
            help="Track that is driven: times laps to less than a period, sees excursions."
        ),
    ] = None,
    compare: Annotated[
        Path | None, typer.Option(help="Run directory of a race: its lap times are drawn beside.")
    ] = None,
    artefact: Annotated[
        Path | None, typer.Option(help="Built controller to learn for; the default one without.")
    ] = None,
    endpoint: Endpoint = None,
    seed: Seed = 0,
    car: Car = DEFAULT_CAR,
    name: CarName = "",
) -> None:
    """Learn from the laps of a car that drives, and hand the weights to its controller.

    After each lap a process in the background trains on what was kept and on what is new, and the
    weights are published. Plant and controller may be started before or after this, and again;
    given the same --out, this too goes on where it was. Start a run with 'bayesrace drive'.
    """
    from bayesrace.vehicles import get_car
    from experiments.learn.job import learn as follow
    from experiments.learn.records import LearnSettings
    from experiments.learn.report import print_laps

    stamp = datetime.now(UTC).astimezone().strftime("%Y%m%d-%H%M%S")
    folder = out or Path("runs") / f"learn-{stamp}"
    parameters = get_car(car)
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
        settings, connect_to(endpoint), folder, typer.echo,
        data=data or (), weights=weights, artefact=artefact,
    )  # fmt: skip
    print_laps(record)
    typer.echo(str(folder))


def _controller(session: object, endpoints: "Endpoints", name: str, timeout_s: float) -> str:
    """The car whose controller is asked; InputError if there is none, or a choice."""
    from experiments.operation import find, pick

    found = find(session, endpoints, timeout_s, name, ("controller",))
    return pick(found, name, False)[0]


def register(app: typer.Typer) -> None:
    """Adds this module's subcommands."""
    for command in (validate, publish, rollback, learn):
        app.command()(command)
