"""mode=render: draw scenes with a renderer, compare its images with true images, and measure the cost of a frame.

Scenes come from files of the user (`mode.files`), or from a data set that has them (`framework.renderer.HasScenes`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from PIL import Image, ImageColor
from pydantic import AfterValidator, Field
from rich.console import Console
from torch import Tensor

from framework.configuration.assembly import Resolved, build_data
from framework.configuration.config import Config, Options
from framework.configuration.loading import find_checkpoint
from framework.configuration.modes import idle_sentence
from framework.configuration.paths import paths_of
from framework.configuration.registry import installed, load
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.datasets.images import open_image
from framework.datasets.png import encode_png
from framework.errors import ConfigError, did_you_mean
from framework.evaluation.rendering import Frame, Ground, Painter, evaluate_frames, frame_cost
from framework.evaluation.splits import require_unique_name
from framework.geometry.srgb import linear_from_bytes
from framework.renderer import HasScenes, Renderer, TrainedRenderer
from framework.reports.frames import RenderResults, Shown, report_frames
from framework.runs.introduction import introduce_threads, print_lines
from framework.runs.job import refuse_idle
from framework.runs.run import Run, open_run
from framework.runs.session import Session, record_citations, set_up_process
from framework.scenes.pictures import INTEGER_IMAGES, write_frames
from framework.scenes.views import FileFrames, View, find_scene_files
from framework.storage.enclosed import require_enclosed
from framework.storage.files import replacing
from framework.storage.first_rank import first_rank
from framework.storage.limits import MOST_SAMPLES
from framework.storage.progress import Work
from framework.target import Target
from framework.training.batches import Batches

if TYPE_CHECKING:  # a metric imports torchmetrics
    from framework.metric import Metric

OF_FILES = (
    *(
        "azimuth",
        "elevation",
        "tilt",
        "distance",
        "fov",
        "height",
        "width",
        "up",
        "camera",
        "frames",
        "shade",
    ),
    *("background", "truth"),
)
"""Options that apply to scene files only, and not to the scenes of a data set."""
OF_A_VIEW = OF_FILES[:8]
"""Options that describe the camera, which a camera file (`mode.camera`) replaces."""
OF_TRAINING = (
    "encoder",
    "density_head",
    "uncertainty",
    "objective",
    "optimizer",
    "trainer",
    "outliers",
    "samples",
)
"""Settings that only the training of a renderer's model reads."""
RATE = 25
"""Frames per second of an animation."""
Channel = Literal["color", "barycentric", "depth", "face", "mask", "normal", "uv"]
Side = Annotated[int, Field(ge=1, le=2**14)]
Angle = Annotated[float, Field(ge=-3600, le=3600)]


def _color(text: str) -> str:
    try:
        ImageColor.getrgb(text)
    except ValueError:
        raise ValueError("expected the name of a colour, such as white, or '#20a0ff'") from None
    return text


class RenderOptions(Options):
    """Options of mode=render; conf/mode/render.yaml explains them."""

    surface: str | None = None
    files: str | None = None
    azimuth: Angle = 30.0
    elevation: Angle = 15.0
    tilt: Angle = 0.0
    distance: Annotated[float, Field(ge=1e-6, le=1e9)] | None = None
    fov: Annotated[float, Field(ge=0.1, le=170)] = 40.0
    height: Side = 480
    width: Side = 640
    up: Literal["y", "z"] | None = None
    camera: str | None = None
    frames: Annotated[int, Field(ge=1, le=3600)] = 1
    shade: bool | None = None
    background: Annotated[str, AfterValidator(_color)] = "white"
    truth: str | None = None
    channels: Annotated[list[Channel], Field(min_length=1)] = ["color"]  # noqa: RUF012 - pydantic copies it
    images: bool | None = None


@dataclass(frozen=True)
class Scenes:
    """Frames that a command draws; the scene of a frame is read shortly before it is drawn.

    Attributes:
        title: name of the scenes in tables.
        count: number of frames.
        groups: names of the groups of frames.
        synthetic: whether the scenes were generated.
        ground: background of the images.
        source: files, or the data set.
        surface: which of a data set's `HasScenes.surfaces` is drawn; "" for files.
        batches: batches of the data set; None for files.
    """

    title: str
    count: int
    groups: Sequence[str]
    synthetic: bool
    ground: Ground
    source: FileFrames | HasScenes
    surface: str = ""
    batches: Batches | None = None

    def blocks(self, size: int) -> Iterator[list[Frame]]:
        """Yield all frames in blocks of at most `size`."""
        source = self.source
        if isinstance(source, FileFrames):
            for first in range(0, self.count, size):
                yield [
                    Frame(source.names[index], source.scene(index), source.batch(index))
                    for index in range(first, min(first + size, self.count))
                ]
            return
        assert self.batches is not None
        for batch in self.batches.test_dataloader():
            scenes = source.scenes(batch, self.surface)
            yield [
                Frame(
                    f"test {int(batch['index'][row])}",
                    scene,
                    {name: field[row : row + 1] for name, field in batch.items() if name != "input"},
                )
                for row, scene in enumerate(scenes)
            ]


def run(config: Config) -> None:
    """Draw all frames, and write the images, results.json and the figures; print the table.

    Raises:
        ConfigError: no renderer or no source of scenes is chosen, or a setting has no effect.
        DataError: a scene or a true image cannot be read, or the renderer cannot draw a scene.
    """
    options = config.options(RenderOptions)
    chosen = _renderer_of(config)
    _refuse_idle_options(config, options)
    session = _session_for_training(config, options, chosen)
    console = set_up_process(config.settings) if session is None else session.console
    if session is None:
        introduce_threads(config.settings.threads, console)
        chosen = _with_checkpoint(config, chosen)
        renderer = build("renderer", chosen)
    else:
        renderer = None
    scenes, parts = _scenes(config, options, session, console)
    metrics = _metrics(parts, options, scenes)
    parts["renderer"] = chosen
    method = _method(config, chosen)
    reads = {channel for metric in metrics for channel in metric.reads}
    channels = tuple(dict.fromkeys([*options.channels, *sorted(reads)]))
    # what the renderer cannot draw is said before a training
    _require_drawable(load("renderer", chosen["name"]), channels, scenes.ground)
    frames = "frame" if scenes.count == 1 else "frames"
    print_lines([f"draws {scenes.count} {frames} of {scenes.title} with {method}"], console)
    with open_run(config) as run:
        console.print(f"run folder: {run.folder}", soft_wrap=True)
        if session is not None:
            session.record(run)
            renderer = _train(session, run, chosen)
            if renderer is None:
                return
        else:
            _record_data(run, scenes, parts)
        record_citations(run, {key: part for key, part in parts.items() if part})
        assert renderer is not None
        painter = Painter(renderer, scenes.ground, channels)
        _draw(run, painter, scenes, metrics, method, options, console)
        if session is not None:
            from framework.runs.resuming import remove_resume_files

            remove_resume_files(run)


def _renderer_of(config: Config) -> dict[str, Any]:
    """Return the resolved config of the renderer.

    Raises:
        ConfigError: none is chosen.
    """
    if not config.settings.renderer:
        names = "|".join(installed("renderer"))
        raise ConfigError(
            f"mode=render needs a renderer. Choose an installed one: renderer={names}; or an experiment that has one."
        )
    return dict(resolve("renderer", config.settings.renderer))


def _refuse_idle_options(config: Config, options: RenderOptions) -> None:
    """Refuse options of the mode that have no effect because of other options."""
    idle: dict[str, str] = {}
    if options.files is None:
        idle |= dict.fromkeys(OF_FILES, "only scenes of mode.files have this option")
    else:
        idle["surface"] = "only the scenes of a data set have this option, and mode.files is set"
        if options.camera is not None:
            idle |= dict.fromkeys(OF_A_VIEW, "mode.camera says the whole view")
    for key, why in idle.items():
        override = config.first_override(f"mode.{key}")
        if override:
            refuse_idle(config.folder, idle_sentence(override, why))
    if options.files is not None:
        groups = ("data", "workers", *(() if options.truth else ("metric",)))
        for key in groups:
            override = config.first_override(key)
            if override:
                why = "mode.files is set" if key != "metric" else "mode.truth names no true images"
                refuse_idle(config.folder, idle_sentence(override, why))


def _session_for_training(
    config: Config, options: RenderOptions, chosen: Mapping[str, Any]
) -> Session | None:
    """Return the session in which the model of the renderer is trained; None if nothing is to be trained.

    Raises:
        ConfigError: a setting of the training has no effect, or the renderer needs a model and none is described.
    """
    settings, name = config.settings, chosen["name"]
    trained = issubclass(load("renderer", name), TrainedRenderer)
    if not trained and settings.checkpoint is not None:
        override = config.first_override("checkpoint") or f"checkpoint={settings.checkpoint}"
        refuse_idle(config.folder, idle_sentence(override, f"renderer={name} has no trained model"))
    has_model = settings.checkpoint is not None or chosen.get("checkpoint") is not None
    if trained and not has_model:
        if options.files is not None or not settings.density_head:
            raise ConfigError(
                f"renderer={name} draws with a trained model. Add checkpoint=<folder of the run that trained it>, or "
                "choose an experiment with a model and a data set of scenes, which is then trained first."
            )
        # Lightning, which this module imports, must be there before `for_training` silences it
        import_module("framework.runs.fit")
        from framework.runs.session import for_training

        return for_training(config)
    why = f"renderer={name} {'has a trained model already' if trained else 'learns nothing'}"
    for key in OF_TRAINING:
        override = config.first_override(key)
        if override:
            refuse_idle(config.folder, idle_sentence(override, why))
    return None


def _with_checkpoint(config: Config, chosen: dict[str, Any]) -> dict[str, Any]:
    """Return the config of the renderer with the checkpoint that the command names.

    Raises:
        ConfigError: both `checkpoint` and `renderer.checkpoint` name one.
        CheckpointError: there is no such checkpoint.
    """
    checkpoint = config.settings.checkpoint
    if checkpoint is None or not issubclass(load("renderer", chosen["name"]), TrainedRenderer):
        return chosen
    if chosen.get("checkpoint") is not None:
        raise ConfigError(
            f"checkpoint={checkpoint} and renderer.checkpoint={chosen['checkpoint']} both name the model of the "
            "renderer. Leave one of them out."
        )
    return {**chosen, "checkpoint": str(find_checkpoint(checkpoint, uri=config.settings.logger.uri))}


def _scenes(
    config: Config, options: RenderOptions, session: Session | None, console: Console
) -> tuple[Scenes, dict[str, Any]]:
    """Return the frames of the command, and the resolved configs of the data set and the metrics.

    Raises:
        ConfigError: the command names neither files nor a data set with scenes.
        DataError: the files or the data are missing or damaged.
    """
    settings = config.settings
    parts: dict[str, Any] = {
        "metric": [resolve("metric", part, f"metric.{key}") for key, part in (settings.metric or {}).items()]
    }
    if options.files is not None:
        if options.truth is None:
            parts["metric"] = []
        return _file_scenes(options, console), parts
    if session is not None:
        parts["data"], data = session.parts["data"], session.data
    elif not settings.data:
        raise ConfigError(
            "mode=render has no scenes to draw. Set mode.files to a scene file or a folder of them, or choose an "
            "experiment or data=... with scenes."
        )
    else:
        parts["data"] = resolve("data", settings.data)
        data = build_data(parts)
    name = parts["data"]["name"]
    if not isinstance(data, HasScenes):
        raise ConfigError(
            f"data={name} has no scenes to draw. Choose a data set of rendered or scanned subjects, or set mode.files."
        )
    surface = options.surface or data.surfaces[0]
    if surface not in data.surfaces:
        raise ConfigError(
            f"mode.surface = {surface}: the scenes of data={name} have only the surfaces {', '.join(data.surfaces)}."
            f"{did_you_mean(surface, data.surfaces)} Choose one of these."
        )
    if session is None:
        data.prepare()
    return _data_scenes(settings, data, name, surface), parts


def _data_scenes(settings: Any, data: Data, name: str, surface: str) -> Scenes:
    assert isinstance(data, HasScenes)
    title = data.title or (data.groups[0] if len(data.groups) == 1 else name)
    batches = Batches(data, batch_size=settings.batch_size, workers=settings.workers, seed=settings.seed)
    count = len(data.splits().test)  # type: ignore[arg-type]
    ground = (data.ground, data.ground, data.ground)
    return Scenes(title, count, data.groups, data.synthetic, ground, data, surface, batches)


def _file_scenes(options: RenderOptions, console: Console) -> Scenes:
    assert options.files is not None
    path = Path(options.files).expanduser()
    files = find_scene_files(path)
    camera = None if options.camera is None else Path(options.camera).expanduser()
    view = View(
        azimuth=options.azimuth,
        elevation=options.elevation,
        tilt=options.tilt,
        distance=options.distance,
        fov=options.fov,
        height=options.height,
        width=options.width,
        up=options.up,
        camera=camera,
    )
    truth = None if options.truth is None else Path(options.truth).expanduser()
    rgb = torch.tensor(ImageColor.getrgb(options.background)[:3], dtype=torch.uint8)
    red, green, blue = linear_from_bytes(rgb).tolist()
    frames = FileFrames(files, view, options.frames, options.shade, truth, (red, green, blue))
    for number, file in enumerate(files):  # also reads every file once, before the run is opened
        print_lines([f"note: {file}: {note}" for note in frames.notes(number)], console)
    first = frames.scene(0).camera
    if first.height * first.width > MOST_SAMPLES:
        raise ConfigError(
            f"The image has {first.width} × {first.height} pixels; at most {MOST_SAMPLES} are possible. Set smaller "
            "mode.width and mode.height."
        )
    frames.batch(0)  # a wrong folder of true images is said before the run is opened
    title = path.name if len(files) == 1 else f"{len(files)} files of {path.name}"
    return Scenes(title, len(frames), (title,), False, frames.ground, frames)


def _metrics(parts: Resolved, options: RenderOptions, scenes: Scenes) -> "list[Metric]":
    """Return the metrics, which read images.

    Raises:
        ConfigError: a metric reads predicted densities, or two metrics have a column in common.
    """
    target = Target("image", ("red", "green", "blue"), size=(options.height, options.width))
    metrics: list[Metric] = []
    owners: dict[str, Metric] = {}
    for part in parts["metric"]:
        metric: Metric = build("metric", part, target=target)
        if not metric.reads:
            raise ConfigError(
                f"The metric {part['name']} reads predicted densities, but mode=render has drawn images. Leave it out, "
                "or choose metrics of images such as psnr."
            )
        for name in metric.columns:
            require_unique_name(owners, name, metric)
        metrics.append(metric)
    return metrics


def _method(config: Config, chosen: Mapping[str, Any]) -> str:
    """Return the name of the renderer in tables: that of the experiment, unless the command chooses the renderer."""
    name = config.settings.experiment_name
    own = any(override.partition("=")[0] == "renderer" for override in config.overrides)
    return name.rpartition("/")[2] if name and not own else str(chosen["name"])


def _require_drawable(cls: type[Renderer], channels: Sequence[str], ground: Ground) -> None:
    """Refuse a renderer class that cannot draw the channels on the background `ground`, before an object is built.

    Raises:
        ConfigError: `Painter` refuses the channels or the background.
    """
    declared = type(cls.__name__, (), {"channels": cls.channels, "background": cls.background})
    Painter(declared(), ground, tuple(channels))  # type: ignore[arg-type]


def _train(session: Session, run: Run, chosen: Mapping[str, Any]) -> Renderer | None:
    """Train the model of the renderer in this run, and return the renderer; None in ranks other than the first."""
    from framework.runs.fit import fit
    from framework.runs.session import calibrate

    _, epoch, _ = fit(session, run)
    if not first_rank():
        return None
    if epoch is not None:
        from framework.reports.report import report_training

        report_training(run, session, kept_epoch=epoch)
    calibrate(session)
    session.save_model(run)
    return build(
        "renderer", {**chosen, "checkpoint": str(run.folder), "paths": dict(paths_of(run.settings.plain()))}
    )


def _record_data(run: Run, scenes: Scenes, parts: Mapping[str, Any]) -> None:
    """Record the data set, or the number of frames of files, that the run draws."""
    source = scenes.source
    if isinstance(source, Data):
        facts = {**source.fingerprint(), "synthetic": str(source.synthetic).lower()}
        run.tracker.set_tags({f"data.{key}": value for key, value in facts.items()})
        run.tracker.log_dataset(parts["data"]["name"], "render", facts)
    else:
        run.tracker.set_tags({"data.scenes": scenes.title})


def _draw(
    run: Run,
    painter: Painter,
    scenes: Scenes,
    metrics: "Sequence[Metric]",
    method: str,
    options: RenderOptions,
    console: Console,
) -> None:
    """Draw and evaluate all frames, measure the cost, and report."""
    size = min(run.settings.batch_size, scenes.count)
    cost = frame_cost(painter, next(scenes.blocks(size)))
    shown = Shown(scenes.count)
    folder = run.folder / "images"
    written = options.images if options.images is not None else isinstance(scenes.source, FileFrames)
    if written:
        folder.mkdir(exist_ok=True)
        require_enclosed(folder)
    number = 0
    with Work("drawing", scenes.count, "frames") as work:

        def keep(frame: Frame, channels: Mapping[str, Tensor]) -> None:
            nonlocal number
            shown.keep(number, frame, channels)
            if written:
                _write_images(folder, frame.name, {name: channels[name] for name in options.channels})
            number += 1
            work.advance(1)

        evaluation = evaluate_frames(painter, scenes.blocks(size), metrics, scenes.groups, keep)
    if written and isinstance(scenes.source, FileFrames) and options.frames > 1:
        _write_animations(folder, scenes.source)
    results = RenderResults(
        method, scenes.title, scenes.synthetic, evaluation, cost, shown, painter.renderer.report
    )
    report_frames(run, results, ["images"] * written, console)


def _write_animations(folder: Path, frames: FileFrames) -> None:
    """Write the frames of each file as an animation `<name of the file>.gif`, if they were written as images."""
    for first in range(0, len(frames), frames.count):
        files = [folder / f"{name}.png" for name in frames.names[first : first + frames.count]]
        if files[0].is_file():
            write_frames(folder / f"{files[0].stem.rpartition('_')[0]}.gif", map(_read_frame, files), RATE)


def _read_frame(file: Path) -> np.ndarray:
    with open_image(file) as image:
        return np.asarray(image)


def _write_images(folder: Path, name: str, channels: Mapping[str, Tensor]) -> None:
    """Write the channels of a frame: colours as `<name>.png`, each other channel as `<name>_<channel>.png`."""
    for channel, image in channels.items():
        if channel == "color":
            with replacing(folder / f"{name}.png") as partial:
                partial.write_bytes(encode_png(image))
        else:
            with replacing(folder / f"{name}_{channel}.png") as partial:
                Image.fromarray(INTEGER_IMAGES[channel](image)).save(partial, "PNG")
