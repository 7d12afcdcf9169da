"""`python -m plugins.data.human_scans.animate <run> [<who>]` animates a person who turns or follows a motion file.

Each frame shows side by side the registered mesh with its vertex colours, the image that the trained network renders,
and, for generated people, the photograph. <run> is a run of smplpix/quick or of a similar experiment. <who> is the name
of a test subject of the run's data, or the file of a mesh with vertex colours in the topology of these data (metres, y
up, facing z).
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
from framework.configuration.loading import read_stored, training_data
from framework.configuration.paths import add_option, parse_paths
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
    """Write the animation that the command's arguments describe, and print the path of its file.

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
        "--motion", type=Path, help="BVH file of a motion, for generated people; default: the person turns"
    )
    parser.add_argument("--frames", type=int, default=60, help="number of frames; default: 60")
    parser.add_argument(
        "--start", type=float, default=0.0, help="time at which the motion begins, seconds; default: 0"
    )
    parser.add_argument(
        "--azimuth",
        type=float,
        default=35.0,
        help="direction of the camera from the front for a motion, degrees; default: 35",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("outputs/animation.gif"),
        help=f"file: {', '.join(KINDS)}; default: %(default)s",
    )
    add_option(parser)
    options = parser.parse_intermixed_args(arguments)
    if options.out.suffix.lower() not in KINDS or options.frames < 1:
        raise ConfigError(
            f"--out {options.out} --frames {options.frames}: expected a file name that ends in {', '.join(KINDS)}, and "
            "1 frame or more."
        )
    sheets = render_animation(
        options.run,
        options.who,
        options.motion,
        options.frames,
        options.start,
        options.azimuth,
        parse_paths(options.path),
    )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write(options.out, sheets)
    sys.stdout.write(f"{options.out}\n")


def render_animation(
    run: str,
    who: str | None,
    file: Path | None,
    frames: int,
    start: float = 0.0,
    azimuth: float = 35.0,
    paths: Mapping[str, str] | None = None,
) -> list[Image.Image]:
    """Return the frames of the animation.

    Args:
        run: run of a trained renderer.
        who: name of a test subject, or the file of a mesh; None for the first test subject.
        file: motion file; None for a person who keeps the pose and is seen from all sides.
        frames: number of frames.
        start: time in the motion file at which the animation starts, s.
        azimuth: azimuth of the camera, degrees, if there is a motion file.
        paths: files and folders by their keys in the run's configuration. A path that is stored in the run is used only
            if it is repeated here.
    """
    description, _ = read_stored(run, paths=paths)
    data: HumanScans = training_data(description, "human_scans")
    mesh: Renderer = build("renderer", resolve("renderer", {"name": "rasterizer", "supersampling": 4}))
    network: Renderer = build(
        "renderer", resolve("renderer", {"name": "smplpix", "checkpoint": run, "paths": paths})
    )
    shown, moments = cast(data, who, file, frames, start)
    turning = [2 * math.pi * number / frames for number in range(frames)]
    azimuths = turning if file is None else [math.radians(azimuth)] * frames
    height, width = description.target.size
    cameras = orbit(moments, azimuths, (height, width))
    frame_images = columns(shown, moments, cameras, {"mesh": mesh, "SMPLpix": network}, data.renderer)
    return [side_by_side(pictures, description.synthetic) for pictures in frame_images]


def cast(
    data: HumanScans, who: str | None, file: Path | None, frames: int, start: float = 0.0
) -> tuple[Actor, list[Moment]]:
    """Return the person to be drawn, and the person's state in each frame.

    Args:
        data: data set that the model was trained on.
        who: name of a test subject, or the file of a mesh; None for the first test subject.
        file: motion file; None to keep the pose.
        frames: number of frames.
        start: time in the motion file at which the animation starts, s.

    Raises:
        ConfigError: a motion is given, but only the mesh of the person is known.
    """
    if who is not None and Path(who).suffix:
        registration = read_registration(Path(who))
    elif data.root is None:
        return follow_motion(generated_person(data, who), file, frames, start)
    else:
        root = Path(data.root).expanduser()
        name = _select_subject(who, read_splits(root)["test"])
        registration = read_registration(root / "subjects" / name / f"registration_{data.topology}.ply")
    if file is not None:
        raise ConfigError(
            f"--motion {file}: the motion cannot be applied to {who or 'this subject'}, because its body model is "
            "unknown. Give a generated person: a test subject of a run whose data.root is null."
        )
    return actor(registration), [Moment(registration.vertices, None)] * frames


def generated_person(data: HumanScans, who: str | None) -> Generated:
    """Return the test subject of generated data with the name `who`; the first one if `who` is None."""
    crowd = Crowd(data.renderer, data.counts, data.drawing, data.data_seed)
    names = [f"test_{number:04}" for number in range(data.counts["test"])]
    return Generated(crowd, "test", names.index(_select_subject(who, names)), data.topology)  # pyright: ignore[reportArgumentType]


def follow_motion(
    person: Generated, file: Path | None, frames: int, start: float = 0.0
) -> tuple[Actor, list[Moment]]:
    """Return a generated person, and the person's state in each frame.

    The person follows the motion file at SPEED frames per second from second `start` on. Without a file, the person
    keeps the pose of the data set.
    """
    if file is None:
        return actor(person.registration), [person.first()] * frames
    recorded = motion.read(file)
    numbers = np.round((start + np.arange(frames) / SPEED) / recorded.seconds).astype(int)
    if numbers[0] < 0 or numbers[-1] >= len(recorded.rotations):
        raise ConfigError(
            f"--frames {frames} take {frames / SPEED:g} s, but from --start {start:g} the motion {file} lasts only "
            f"{len(recorded.rotations) * recorded.seconds - start:.3g} s more. Lower --frames or --start."
        )
    poses = motion.transfer_motion(person.crowd.body, recorded, numbers.tolist())
    return actor(person.registration), [person.at(pose) for pose in poses]


def _select_subject(who: str | None, names: Sequence[str]) -> str:
    name = names[0] if who is None else who
    if name not in names:
        raise DataError(
            f"There is no test subject {name!r}.{did_you_mean(name, names)} The test subjects are {', '.join(names)}. "
            "To animate the mesh in a file, give the file with its suffix, as in ann.ply."
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
            f"{file}: MP4 files are written by the program ffmpeg, which is not installed. Install ffmpeg, or write a "
            ".gif or .webp file."
        )
    width, height = frames[0].size
    input_options = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {SPEED} -i -"
    output_options = "-vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -pix_fmt yuv420p"
    command = [
        program,
        "-y",
        "-loglevel",
        "error",
        *input_options.split(),
        *output_options.split(),
        str(file),
    ]
    content = b"".join(np.asarray(frame).tobytes() for frame in frames)
    process = subprocess.run(command, input=content, capture_output=True, check=False)
    if process.returncode:
        raise DataError(
            f"{file}: ffmpeg could not write this file: {process.stderr.decode(errors='replace').strip()}"
        )


if __name__ == "__main__":
    run_command(main)
