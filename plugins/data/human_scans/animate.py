"""`python -m plugins.data.human_scans.animate <run> [<who>]` animates a person who turns or follows a motion file.

Each frame shows side by side the registered mesh with its vertex colours, the image that the trained network renders,
and, for generated people, the photograph. <run> is a run of smplpix/quick or of a similar experiment. <who> is a test
subject of its data, or a coloured mesh of its topology (metres, y up, facing z).
"""

import argparse
import math
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from framework.bodies import motion
from framework.configuration.description import Description
from framework.configuration.loading import read_stored
from framework.configuration.paths import add_option, parse_paths, require_paths
from framework.configuration.schema import build, resolve
from framework.datasets.scan_layout import read_registration, read_splits
from framework.errors import ConfigError, DataError, did_you_mean
from framework.renderer import Renderer
from framework.storage.commands import run_command
from plugins.data.human_scans.animation import Actor, Generated, Moment, actor, columns, orbit, side_by_side
from plugins.data.human_scans.data import HumanScans
from plugins.data.human_scans.scan_generator import Crowd

KINDS = (".gif", ".webp", ".mp4")
SPEED = 20
"""Frames per second."""
NEARLY_WHITE = 248  # of 255: colours of a GIF's palette from here on become the white background


def main(arguments: list[str]) -> None:
    """Write the animation, frame by frame.

    Raises:
        UserError: the run is of other data, the person does not exist, or a file cannot be read or written.
    """
    parser = argparse.ArgumentParser(
        prog="python -m plugins.data.human_scans.animate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run", help="run folder, checkpoint file or MLflow run id")
    parser.add_argument(
        "who", nargs="?", help="test subject, or mesh with vertex colours; default: the first subject"
    )
    parser.add_argument(
        "--motion", type=Path, help="BVH file of a walk, say: for generated people; default: they turn"
    )
    parser.add_argument("--frames", type=int, default=60, help="pictures; default: 60")
    parser.add_argument(
        "--start", type=float, default=0.0, help="second of the motion at which it begins; default: 0"
    )
    parser.add_argument(
        "--azimuth", type=float, default=35.0, help="degrees from the front, of a walk; default: 35"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("outputs/animation.gif"),
        help=f"file: {', '.join(KINDS)}; default: %(default)s",
    )
    add_option(parser)
    given = parser.parse_intermixed_args(arguments)
    if given.out.suffix.lower() not in KINDS or given.frames < 1:
        raise ConfigError(
            f"--out {given.out} --frames {given.frames}: wanted a {', '.join(KINDS)} and 1 frame or more."
        )
    sheets = animated(
        given.run, given.who, given.motion, given.frames, given.start, given.azimuth, parse_paths(given.path)
    )
    given.out.parent.mkdir(parents=True, exist_ok=True)
    write(given.out, sheets)
    sys.stdout.write(f"{given.out}\n")


def animated(
    run: str,
    who: str | None,
    file: Path | None,
    frames: int,
    start: float = 0.0,
    azimuth: float = 35.0,
    paths: Mapping[str, str] | None = None,
) -> list[Image.Image]:
    """Return the frames of the animation.

    The arguments are those of the command; `paths` is the argument of the same name of `framework.load`.
    """
    description, _ = read_stored(run, paths=paths)
    data = data_of(description)
    mesh: Renderer = build("renderer", resolve("renderer", {"name": "rasterizer", "supersampling": 4}))
    network: Renderer = build(
        "renderer", resolve("renderer", {"name": "smplpix", "checkpoint": run, "paths": paths})
    )
    shown, moments = cast(data, who, file, frames, start)
    turning = [2 * math.pi * number / frames for number in range(frames)]
    azimuths = turning if file is None else [math.radians(azimuth)] * frames
    height, width = description.target.size
    cameras = orbit(moments, azimuths, (height, width))
    drawn = columns(shown, moments, cameras, {"mesh": mesh, "SMPLpix": network}, data.renderer)
    return [side_by_side(pictures, description.synthetic) for pictures in drawn]


def data_of(description: Description) -> HumanScans:
    """Return the data set that a model was trained on, without preparing it."""
    part = description.config["data"]
    if part["name"] != "human_scans":
        raise ConfigError(
            f"{description.path} was trained on data {part['name']!r}; wanted a model trained on `human_scans`, which "
            "paints people."
        )
    require_paths(description.dropped, ("data",), description.path)
    return build("data", resolve("data", part))


def cast(
    data: HumanScans, who: str | None, file: Path | None, frames: int, start: float = 0.0
) -> tuple[Actor, list[Moment]]:
    """Return the person to be drawn, and the person's state in each frame."""
    if who is not None and Path(who).suffix:
        registration = read_registration(Path(who))
    elif data.root is None:
        return moving(generated(data, who), file, frames, start)
    else:
        root = Path(data.root).expanduser()
        name = _chosen(who, read_splits(root)["test"])
        registration = read_registration(root / "subjects" / name / f"registration_{data.topology}.ply")
    if file is not None:
        raise ConfigError(
            f"--motion {file}: of {who or 'this subject'} only a mesh is known, and not the body in it; wanted a "
            "person that was generated, a test subject of a run whose data.root is null."
        )
    return actor(registration), [Moment(registration.vertices, None)] * frames


def generated(data: HumanScans, who: str | None) -> Generated:
    """Return a test subject of generated data."""
    crowd = Crowd(data.renderer, data.counts, data.drawing, data.data_seed)
    names = [f"test_{number:04}" for number in range(data.counts["test"])]
    return Generated(crowd, "test", names.index(_chosen(who, names)), data.topology)  # pyright: ignore[reportArgumentType]


def moving(
    person: Generated, file: Path | None, frames: int, start: float = 0.0
) -> tuple[Actor, list[Moment]]:
    """Return a generated person who follows a motion file at SPEED frames per second, or keeps one pose without it."""
    if file is None:
        return actor(person.registration), [person.first()] * frames
    found = motion.read(file)
    numbers = np.round((start + np.arange(frames) / SPEED) / found.seconds).astype(int)
    if numbers[0] < 0 or numbers[-1] >= len(found.rotations):
        raise ConfigError(
            f"{frames} pictures last {frames / SPEED:g} s; from second {start:g} on {file} has "
            f"{len(found.rotations) * found.seconds - start:.3g} s. Lower --frames or --start."
        )
    poses = motion.poses_of(person.crowd.body, found, numbers.tolist())
    return actor(person.registration), [person.at(pose) for pose in poses]


def _chosen(who: str | None, names: Sequence[str]) -> str:
    name = names[0] if who is None else who
    if name not in names:
        raise DataError(
            f"no test subject is called {name!r}.{did_you_mean(name, names)} There are {', '.join(names)}; a mesh is "
            "named with its suffix, as ann.ply."
        )
    return name


def write(file: Path, frames: Sequence[Image.Image]) -> None:
    """Write the frames as an animation of SPEED frames per second.

    Raises:
        DataError: an MP4 is wanted and the program ffmpeg is missing, or fails to write it.
    """
    kind = file.suffix.lower()
    if kind == ".mp4":
        _film(file, frames)
        return
    if kind == ".gif":  # one palette for all frames and no dithering: the background must not flicker
        some = frames[:: max(len(frames) // 8, 1)]
        every = np.concatenate([np.asarray(frame) for frame in some])
        palette = Image.fromarray(every).quantize(256)
        colors = np.array(palette.getpalette()).reshape(-1, 3)
        colors[colors.min(1) >= NEARLY_WHITE] = 255
        palette.putpalette(colors.ravel().tolist())
        frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    first, *rest = frames
    first.save(file, save_all=True, append_images=rest, duration=1000 // SPEED, loop=0, quality=90)


def _film(file: Path, frames: Sequence[Image.Image]) -> None:
    program = shutil.which("ffmpeg")
    if program is None:
        raise DataError(
            f"{file}: an MP4 is made by the program ffmpeg, which is not installed. Install it, or write a .gif or "
            ".webp."
        )
    width, height = frames[0].size
    given = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {SPEED} -i -"
    wanted = "-vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -pix_fmt yuv420p"
    command = [program, "-y", "-loglevel", "error", *given.split(), *wanted.split(), str(file)]
    content = b"".join(np.asarray(frame).tobytes() for frame in frames)
    done = subprocess.run(command, input=content, capture_output=True, check=False)
    if done.returncode:
        raise DataError(f"{file}: ffmpeg could not write it: {done.stderr.decode(errors='replace').strip()}")


if __name__ == "__main__":
    run_command(main)
