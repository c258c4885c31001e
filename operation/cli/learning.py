"""``collect``, ``import-drive``, ``identify``, ``train``, ``validate``, ``learn``, ``publish``,
``rollback``: from drives to a car's file, and to weights in use."""

from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import typer

from bayesrace.defaults import MAX_POINTS, POINTS
from bayesrace.errors import InputError
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, options_of
from bayesrace.operation.terminal import UNCERTAIN

if TYPE_CHECKING:
    from bayesrace.learning.settings import TrainingSettings
    from bayesrace.learning.training import Training
    from bayesrace.operation.learn.records import LearnSettings
    from bayesrace.operation.settings import PreparationSettings
    from bayesrace.transport import Endpoints

__all__ = ["collect", "identify", "import_drive", "learn", "publish", "rollback", "train"]
__all__ += ["validate"]

_ARTEFACT: Final = options.value(
    "Built controller to learn for.", metavar="DIR", shown="the default one"
)
_NAME: Final = options.value(
    "Name of the car.", "", "--name", "--car", shown="the only one that is found"
)
_TIMEOUT: Final = options.value(
    "Time limit [s], once for finding the controller and once for its answer.",
    metavar="S",
    min=0.1,
    max=600.0,
    shown="5 and 20",
)


@options_of(
    "bayesrace.operation.settings.PreparationSettings",
    "collect_s=--duration pursuit.style seed fmu fmu_map simulator sensors car",
)
def collect(
    settings: "Given[PreparationSettings]",
    track: str = options.TRACK_GIVEN,
    raceline: Path = options.RACELINE,
    race_line: Path | None = options.value(
        "Racing line to be driven with what is learned: says how much of it was driven.",
        None,
        "--for",
        metavar="FILE",
    ),
    out: Path = options.out_file(Path("collect.mcap")),
) -> None:
    """Drive a track by pure pursuit and log the drive as training data."""
    import numpy as np

    from bayesrace.codegen.build import build
    from bayesrace.codegen.settings import BuildSettings
    from bayesrace.learning.coverage import coverage
    from bayesrace.operation.training_drives import drive_for_training
    from bayesrace.raceline import read_raceline, read_raceline_for
    from bayesrace.tracks import load_track

    chosen = settings()
    car = chosen.car
    course = load_track(track, car.width_m)
    line = read_raceline_for(raceline, course, car)
    asked = None if race_line is None else read_raceline(race_line)
    artefact, _ = build(BuildSettings(car=car))
    driven = drive_for_training(chosen, course, line, car, artefact, out)
    x = np.concatenate([one.x[:-1] for one in driven])
    off_track = course.project_path(x[:, :2]).off_track_m > 0
    typer.echo(
        f"{len(driven)} {'drive' if len(driven) == 1 else 'drives'}, {len(x)} samples, "
        f"{int(off_track.sum())} of them off the track, up to {float(x[:, 3].max()):.2f} m/s: {out}"
    )
    if asked is not None:
        typer.echo(f"{race_line}: {coverage([asked], x)}")


def import_drive(
    drive: Path = options.argument("DRIVE", "CSV file, or rosbag2 recording (MCAP, SQLite)."),
    names: Path | None = options.value(
        "TOML file that says what its names and units mean: docs/learning.md.",
        None,
        "--map",
        metavar="FILE",
        shown="our names in CSV, F1TENTH's in bags",
    ),
    car: str = options.CAR,
    rate: float = options.value("States a second [Hz].", 50.0, min=1.0, max=500.0),
    track: str = options.value("Name of the track, for the log.", ""),
    out: Path = options.out_file(Path("imported.mcap")),
) -> None:
    """Make a log of a drive that others have recorded, to train and identify with.

    States are interpolated to even times, inputs are held. What has gaps or jumps is left out, and
    counted.
    """
    from bayesrace.files import read_form
    from bayesrace.learning.dataset import left_out
    from bayesrace.learning.foreign import DriveMap, read_drive, write_drive
    from bayesrace.vehicles import get_car

    driven, remedy = get_car(car), "docs/learning.md has the form"
    map_ = DriveMap() if names is None else read_form(names, "the map", remedy, DriveMap)
    found = read_drive(drive, map_, driven, 1 / rate)
    write_drive(out, found, driven, track)
    typer.echo(
        f"{len(found.x)} states at {rate:g} Hz in {len(set(found.run))} unbroken parts "
        f"(left out: {left_out(found.dropped)}): {out}"
    )


def identify(
    logs: list[Path] = options.argument("LOG", "Run logs (MCAP) of drives of the car.", ()),
    car: str = options.value(
        "Car to begin with, of whose file geometry and mass stay.", "", shown="named by the logs"
    ),
    out: Path = options.out_file(Path("identified.toml")),
    picture: Path | None = options.new_file("Draw accelerations, measured and modelled (PNG)."),
    wheelbase: bool = options.flag("--wheelbase", "Find the wheelbase, too; steering gain is 1."),
    tyres: bool = options.flag("--tyres", "Write tyres and yaw inertia, too, to simulate the car."),
    name: str = options.CAR_NAME,
) -> None:
    """Identify a car from drives: what its file needs and a ruler does not measure.

    Motor and drag, delays, the steering's offset, gain and lag, friction, and the sensors' noise,
    each with its standard error. The drives excite both inputs, as those of 'collect' do.
    """
    from bayesrace.learning.identification import identify as identified_of
    from bayesrace.learning.instruments import read_drives
    from bayesrace.learning.sources import recorded_car
    from bayesrace.operation.terminal import tables
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.vehicles import get_car, write_car

    parameters, drivers = recorded_car(logs, get_car(car) if car else None, name)
    with options.stages_shown() as stages, stages.stage("identify the car") as stage:
        drives = read_drives(drivers)
        found = identified_of(
            parameters, drives, wheelbase=wheelbase, tyres=tyres, progress=stage.update
        )
    if picture is not None:
        from bayesrace.operation.report.identification import write_comparison

        write_comparison(found.comparison, found.car, picture)
    remarks, of_sensors = found.remarks([path.name for path in logs]), found.sensor_remarks()
    write_car(out, found.car, remarks, of_sensors)
    tables.print_identified(found, Terminal())
    typer.echo(f"{out}")


@options_of("bayesrace.learning.settings.TrainingSettings", "restarts seed")
def train(
    settings: "Given[TrainingSettings]",
    logs: list[Path] = options.argument("LOG", "Run logs (MCAP).", ()),
    data: list[Path] = options.value("Samples in plain arrays (.npz); repeatable.", ()),
    kernel: Literal["rbf", "matern05", "matern15", "matern25", "auto"] = options.value(
        "rbf, matern05, matern15, matern25; auto: the best per output.", "auto"
    ),
    out: Path = options.out_file(Path("weights.bin")),
    points: str = options.value(
        f"Points per output, 20 to {MAX_POINTS}; auto: the fewest that cost no lap time.",
        f"{POINTS[0]}",
        metavar="N|auto",
    ),
    track: list[str] = options.value(
        "Track that auto drives; repeatable.", (), shown="those of the logs"
    ),
    artefact: Path | None = _ARTEFACT,
    car: str = options.value("Car that drove.", "", shown="named by the files"),
    name: str = options.CAR_NAME,
    all_samples: bool = options.ALL_SAMPLES,
) -> None:
    """Train the three GPs on the residual in run logs or plain arrays.

    Of more samples than --points, those with the largest predictive variance are chosen one by one.
    auto: fewer than 400 are enough if a controller's laps with them are shown to be at most 0.1 %
    slower, with what is learned from the drives as the car.
    """
    from bayesrace.gp.weights import KERNELS, write_weights
    from bayesrace.learning.dataset import left_out
    from bayesrace.learning.sources import read_samples
    from bayesrace.learning.training import fit
    from bayesrace.learning.validation import discretisation_of
    from bayesrace.manifest import read_manifest
    from bayesrace.operation.terminal import tables
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.vehicles import get_car

    auto = points == "auto"
    count = POINTS[0] if auto else _count(points)
    if track and not auto:
        raise InputError("--track: for --points auto alone; leave it out, or add that")
    wanted, parameters = None, get_car(car) if car else None
    if artefact is not None:
        manifest = read_manifest(artefact)
        parameters = parameters or get_car(manifest.car)
        wanted = discretisation_of(manifest.discretisation, parameters)
        if not auto:
            manifest.check_points(count)
        elif manifest.gp_capacity < count:
            raise InputError(
                f"--points auto drives with {count} points, {artefact} has room for "
                f"{manifest.gp_capacity}: leave out --artefact"
            )
    samples = read_samples([*logs, *data], parameters, name, wanted, limits=not all_samples)
    kernels, console = tuple(KERNELS) if kernel == "auto" else (kernel,), Terminal()
    with options.stages_shown() as stages:

        def trained(capacity: int) -> "Training":
            wanted = settings(kernels=kernels, capacity=capacity)
            with stages.stage("train the residual") as stage:
                return fit(samples.dataset, samples.discretisation, wanted, progress=stage.update)

        if auto:
            from bayesrace.operation.fewest_points import driven_tracks, fewest_points

            tracks = driven_tracks(samples, [*logs, *data], track)
            attempts, chosen = fewest_points(samples, tracks, artefact, trained, stages)
            training = chosen.training
        else:
            training = trained(count)
    if auto:
        tables.print_points(attempts, chosen, console)
    weights = training.weights
    write_weights(out, weights)
    tables.print_kernels(training.kernels, console)
    typer.echo(
        f"{weights.version}: {len(samples.dataset)} samples "
        f"(left out: {left_out(samples.dataset.dropped)}), "
        f"kernels {', '.join(weights.kernels)}: {out}"
    )
    tables.print_beyond_limits(samples.dataset.dropped, len(samples.dataset), console)


def _count(text: str) -> int:
    """Of training points, from an option."""
    if not text.isdecimal() or not 20 <= int(text) <= MAX_POINTS:
        raise InputError(f"--points {text}: give a number from 20 to {MAX_POINTS}, or auto")
    return int(text)


def validate(
    weights: Path = options.argument("WEIGHTS", "Weights file, as 'bayesrace train' writes it."),
    on: list[Path] = options.value("Run log (MCAP) or arrays (.npz); repeatable.", ...),
    json_file: Path | None = options.new_file("Write the numbers to this file.", "--json"),
    out: Path | None = options.out_folder("Folder for numbers, error.png and track.png."),
    track: str | None = options.value(
        "Track for track.png: name, random:SEED, random10:SEED or CSV file."
    ),
    threshold: float = options.value(
        "Mark samples whose largest sigma is above.", UNCERTAIN, min=0, metavar="SIGMA"
    ),
    run: list[int] = options.value("Only this run of the log; repeatable.", ()),
    car: str = options.value("TOML file of the weights' car if it is not built in.", ""),
    name: str = options.CAR_NAME,
    all_samples: bool = options.ALL_SAMPLES,
) -> None:
    """Validate weights on a drive: error, coverage, and drift over one step and the horizon.

    Use drives that the weights were not trained on. The filters of the training apply here, too;
    --all-samples keeps samples beyond the car's limits.
    """

    from bayesrace.gp.weights import read_weights
    from bayesrace.operation.analysis.validation import validate_weights
    from bayesrace.operation.terminal.tables import print_validation
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    parameters = get_car(car) if car else None
    course = None if track is None else load_track(track)
    judged = validate_weights(
        read_weights(weights),
        on,
        name,
        tuple(run) or None,
        threshold,
        parameters,
        limits=not all_samples,
    )
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    for path in (json_file, out and out / "validation.json"):
        options.write_json(path, judged.result)
    if out is not None:
        from bayesrace.operation.report.gp import write_validation

        write_validation(judged, threshold, out, course)
    print_validation(judged.result, Terminal())


def publish(
    learning: "Endpoints",
    weights: Path = options.argument("WEIGHTS", "Weights file, as 'bayesrace train' writes it."),
    name: str = _NAME,
    timeout: float | None = _TIMEOUT,
) -> None:
    """Send new weights to a running controller, and wait for its answer.

    Exit code 0 once it drives with them, 1 if it refuses them (the message says if a later attempt
    can succeed), 2 if it cannot be reached.
    """
    from bayesrace.gp.weights import encode_weights, read_weights
    from bayesrace.operation.learn.publishing import accepted
    from bayesrace.transport import send_weights

    data = encode_weights(read_weights(weights))
    typer.echo(accepted(learning, name, timeout, send_weights, data)[0])


def rollback(
    learning: "Endpoints",
    name: str = _NAME,
    reason: str = options.value("Reason, for the controller's event.", "", metavar="TEXT"),
    timeout: float | None = _TIMEOUT,
) -> None:
    """Let a controller return to the weights before those in use.

    Exit code 0 once it drives with them, 1 if there are none, 2 if it cannot be reached.
    """
    from bayesrace.operation.learn.publishing import accepted
    from bayesrace.transport import send_rollback

    why = reason or "bayesrace rollback"
    text, reply = accepted(learning, name, timeout, send_rollback, why)
    before = reply.data.get("from_version")
    typer.echo(text + (f", instead of {before}" if before else ""))


@options_of(
    "bayesrace.operation.learn.records.LearnSettings",
    "laps every points keep track seed car name",
)
def learn(
    learning: "Endpoints",
    settings: "Given[LearnSettings]",
    watch: bool = options.flag("--watch", "Learn after each lap until Ctrl-C, not after one lap."),
    data: list[Path] = options.value("First samples: log (MCAP) or arrays (.npz); repeatable.", ()),
    weights: Path | None = options.value("First weights, which are sent to the controller."),
    out: Path | None = options.out_folder(
        "Folder for results, or of a job to resume (--data and --weights do not count then).",
        "runs/learn-DATE-TIME",
    ),
    artefact: Path | None = _ARTEFACT,
) -> None:
    """Learn from the laps of a driving car, and send the weights to its controller.

    After each lap a background process trains on the samples that were kept and on the new ones,
    and publishes the weights. Plant and controller may start before or after this command, and
    restart; with the same --out, this command resumes. Start a run with 'bayesrace drive'.
    """
    from bayesrace.transport import check_session

    chosen = settings() if watch or "--laps" in settings.flags else settings(laps=1)
    learning.check_car(chosen.name)
    check_session(learning, "learning")  # before imports that take seconds
    from bayesrace.operation.learn.job import learn as follow
    from bayesrace.operation.learn.report import print_laps

    folder = options.run_folder(out, "learn-")
    record = follow(
        chosen, learning, folder, typer.echo, data=data, weights=weights, artefact=artefact
    )
    print_laps(record)
    typer.echo(f"{folder}")
