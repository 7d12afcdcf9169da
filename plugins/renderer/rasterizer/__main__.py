"""`python -m plugins.renderer.rasterizer <scene>` draws a user's file: a picture, or a film around it."""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import torch
from numpy.typing import NDArray
from PIL import ImageColor

from framework.errors import ConfigError, DataError, did_you_mean, quote, shorten
from framework.geometry.camera import Camera
from framework.renderer import Report
from framework.storage.commands import run_command
from framework.storage.limits import MOST_SAMPLES
from framework.storage.progress import track_progress
from plugins.renderer.rasterizer import pictures, turntable
from plugins.renderer.rasterizer.parts import Axis
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.scene_files import UPWARDS, read

EXAMPLE = """
--camera names a JSON or YAML file with an exact camera, OpenCV's: a point X of the scene is seen at pixel
(fx x/z + cx, fy y/z + cy), (x, y, z) = R X + t; pixel centres lie at whole numbers, x right, y down, z forward.
  {"K": [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
   "t": [0, 0, 2], "size": [640, 480]}

examples:
  python -m plugins.renderer.rasterizer chair.glb --azimuth 40 --out chair.png
  python -m plugins.renderer.rasterizer chair.glb --turntable 60 --out chair.gif
  python -m plugins.renderer.rasterizer chair.glb --camera camera.json --channel depth --out depth.npy
"""
VIEW = {"azimuth": 30.0, "elevation": 15.0, "tilt": 0.0, "distance": "auto", "fov": 40.0, "size": (480, 640)}
"""Default view where no camera file is given.

Angles and field of view are in degrees, the distance is in metres, the size in pixels.
"""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a mistake in one sentence, without printing the usage first."""

    def error(self, message: str) -> NoReturn:
        message = shorten(message)
        if message.startswith("unrecognized arguments: "):
            message += "." + did_you_mean(message.split()[2].partition("=")[0], self._option_string_actions)
        raise ConfigError(f"{message}{'' if message[-1] in '.?' else '.'} --help says what there is.")


def number(
    low: float | int, high: float | int, unit: str, *, kind: type = float
) -> Callable[[str], float | int]:
    """Return a function that reads a number from `low` to `high`."""

    def parse(text: str) -> float | int:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            what = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(
                f"{quote(text)} came; wanted {what} from {low:g} to {high:g}{unit}"
            )
        return value

    return parse


def distance(text: str) -> float | int | str:
    """Return a distance in metres, or "auto", read from a text."""
    return text if text == "auto" else number(1e-6, 1e9, ", metres, or auto")(text)


def size(text: str) -> tuple[int, int]:
    """Return (height, width) read from a text such as 640x480."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(
        side.isdecimal() and 1 <= int(side) <= turntable.LONGEST_SIDE for side in sides
    ):
        raise argparse.ArgumentTypeError(
            f"{quote(text)} came; wanted WIDTHxHEIGHT in pixels, each from 1 to {turntable.LONGEST_SIDE}, as 640x480"
        )
    return int(sides[1]), int(sides[0])


def background(text: str) -> tuple[int, int, int] | None:
    """Return a colour as red, green and blue, 0 to 255, read from a text; None for transparent."""
    if text == "transparent":
        return None
    try:
        red, green, blue, *_ = ImageColor.getrgb(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{quote(text)} came; wanted a colour, as white or #20a0ff, or transparent."
            + did_you_mean(text, ["transparent", *ImageColor.colormap])
        ) from None
    return red, green, blue


def channel(text: str) -> str:
    """Return the name of a channel if the renderer draws it."""
    known = sorted(Rasterizer.channels)
    if text not in known:
        near = did_you_mean(text, known)
        raise argparse.ArgumentTypeError(
            f"{quote(text)} came; wanted one of {', '.join(known)}.{near}".rstrip(".")
        )
    return text


def parser() -> Parser:
    """Return the parser of the command's arguments."""
    found = Parser(
        prog="python -m plugins.renderer.rasterizer",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = found.add_argument
    add("scene", type=Path, help=f"a file whose name ends in {', '.join(UPWARDS)}; its textures beside it")
    add("--out", type=Path, help=".png, .gif, .mp4 or .npy; default: outputs/<scene>.png, .gif of a film")
    angle = number(-3600, 3600, " degrees")
    add("--azimuth", type=angle, help="degrees around the subject, 0 sees its front; default: 30")
    add("--elevation", type=angle, help="degrees above the horizon; default: 15")
    add("--tilt", type=angle, help="degrees by which the camera rolls; default: 0")
    add(
        "--distance", type=distance, help="metres from the subject's centre; default: auto, all of it is seen"
    )
    add("--fov", type=number(0.1, 170, " degrees"), help="degrees from top to bottom; default: 40")
    add("--size", type=size, help="WIDTHxHEIGHT in pixels; default: 640x480")
    add("--up", choices=("y", "z"), help="the subject's vertical axis; default: y, but z of .off and .stl")
    add("--camera", type=Path, help="a file with K, R, t, size instead of the above; see below")
    add("--turntable", type=number(2, 3600, "", kind=int), help="frames of a film once around the subject")
    add(
        "--rate",
        type=number(1, 50, " frames a second", kind=int),
        default=25,
        help="frames a second; default: 25",
    )
    add(
        "--background",
        type=background,
        default="gainsboro",
        help="a colour, or transparent (.png); default: gainsboro",
    )
    add(
        "--supersampling",
        type=number(1, 16, "", kind=int),
        default=3,
        help="samples along a pixel's side; default: 3",
    )
    add("--channel", type=channel, default="color", help=f"one of {', '.join(sorted(Rasterizer.channels))}")
    add(
        "--shade",
        action=argparse.BooleanOptionalAction,
        help="light at the camera; default: where one colour is all",
    )
    add("--report", action="store_true", help="say what the renderer left out, and milliseconds a frame")
    return found


def main(arguments: list[str]) -> None:
    """Draw a file and write the image; print its name to the output, and notes and the report to the error stream.

    Raises:
        UserError: the request cannot be carried out, or a file cannot be read.
        OSError: the place cannot be written.
    """
    given = parser().parse_args(arguments)
    out = given.out or Path("outputs", given.scene.stem + (".png" if given.turntable is None else ".gif"))
    check(given, out)
    subject = read(given.scene)
    for note in subject.notes:
        sys.stderr.write(f"note: {given.scene}: {note}\n")
    if given.channel == "uv" and subject.scene.texture is None:
        raise DataError(
            f"{given.scene}: it has no texture; wanted one for --channel uv. Ask for another channel."
        )
    up = given.up or subject.up
    around = turntable.ball(subject.scene)
    camera = chosen_camera(given, around, up)
    check_size(camera, given, out)
    count = given.turntable or 1
    cameras = track_progress(turntable.around(camera, around.centre, up, count), "drawing", count, "frames")
    renderer = Rasterizer(supersampling=given.supersampling if given.channel == "color" else 1)
    seconds: list[float] = []
    staged = pictures.stage(subject, given.shade if given.channel == "color" else False)
    numbers = out.suffix.lower() == ".npy"

    def frames() -> Iterator[NDArray]:
        for place in cameras:
            scene = staged.seen(place)
            began = time.perf_counter()
            try:
                if given.report and not seconds:  # the first drawing compiles the kernels, so it is not timed
                    Rasterizer(supersampling=renderer.supersampling)(scene, (given.channel,))
                    began = time.perf_counter()
                drawn = renderer(scene, (given.channel,))[given.channel]
            except ValueError as error:  # the message says in a sentence what the renderer cannot draw
                raise DataError(f"{given.scene}: {error}") from error
            seconds.append(time.perf_counter() - began)
            if given.channel == "color" and not numbers:
                yield pictures.color(drawn, given.background)
            else:
                yield drawn.numpy() if numbers else pictures.CODES[given.channel](drawn)

    with torch.no_grad():
        pictures.write(out, frames(), given.rate)
    if renderer.report is not None and not renderer.report.drawn_faces:
        sys.stderr.write(f"note: {given.scene}: no face of it is seen in the last picture.\n")
    if given.report:
        sys.stderr.write(told(renderer.report, seconds))
    sys.stdout.write(f"{out}\n")


def check(given: argparse.Namespace, out: Path) -> None:
    """Refuse what can be refused before any file is read.

    Raises:
        ConfigError: the arguments contradict each other or `out`.
    """
    suffix = out.suffix.lower()
    if suffix not in pictures.SUFFIXES:
        raise ConfigError(
            f"--out {out} came; wanted a name that ends in {', '.join(pictures.SUFFIXES)}."
            f"{did_you_mean(suffix, pictures.SUFFIXES)}"
        )
    if out.is_dir():
        raise ConfigError(f"--out {out} is a folder; wanted the name of a file.")
    twice = [name for name in VIEW if getattr(given, name) is not None]
    if given.camera is not None and twice:
        raise ConfigError(f"--{twice[0]} came beside --camera, whose file says it; wanted one of the two.")
    film = suffix in (".gif", ".mp4")
    if film and given.turntable is None:
        raise ConfigError(
            f"--out {out} is a film; wanted --turntable and its number of frames, as --turntable 60."
        )
    if suffix == ".png" and given.turntable is not None:
        raise ConfigError(f"--turntable came, but --out {out} holds one picture; wanted .gif, .mp4 or .npy.")
    if given.background is None and (suffix != ".png" or given.channel != "color"):
        raise ConfigError("--background transparent came; wanted it with colours and a .png alone.")
    if film and given.channel in ("depth", "face"):
        raise ConfigError(
            f"--channel {given.channel} came, whose numbers films do not hold; wanted .npy, or one .png."
        )
    if suffix != ".npy" and given.channel != "color" and given.channel not in pictures.CODES:
        raise ConfigError(f"--channel {given.channel} came, which pictures do not hold; wanted a .npy.")
    if suffix == ".mp4":
        pictures.encoder()


def chosen_camera(given: argparse.Namespace, around: turntable.Ball, up: Axis) -> Camera:
    """Return the camera that a file or the arguments describe."""
    if given.camera is not None:
        return turntable.read_camera(given.camera)
    chosen = {name: getattr(given, name) for name in VIEW}
    chosen = {name: VIEW[name] if value is None else value for name, value in chosen.items()}
    angles = math.radians(chosen["azimuth"]), math.radians(chosen["elevation"]), math.radians(chosen["tilt"])
    far = None if chosen["distance"] == "auto" else chosen["distance"]
    return turntable.looking_at(around, up, angles, far, math.radians(chosen["fov"]), chosen["size"])


def check_size(camera: Camera, given: argparse.Namespace, out: Path) -> None:
    """Refuse an image that is too large, or whose size its file format cannot hold."""
    samples = camera.height * camera.width * given.supersampling**2
    if samples > MOST_SAMPLES:
        raise ConfigError(
            f"{camera.width}x{camera.height} pixels of {given.supersampling}x{given.supersampling} samples came; "
            f"wanted at most {MOST_SAMPLES} samples. Ask for a smaller --size or --supersampling."
        )
    if out.suffix.lower() == ".mp4" and (camera.height % 2 or camera.width % 2):
        raise ConfigError(f"{camera.width}x{camera.height} pixels came; wanted even numbers for an .mp4.")


def told(report: Report | None, seconds: list[float]) -> str:
    """Return the report of the last image, and the median time per frame, as text."""
    lines = []
    if report is not None:
        left = ", ".join(f"{count} {reason}" for reason, count in report.left_out.items()) or "none"
        lines.append(
            f"{report.drawn_faces} of {report.faces} faces drawn, in {report.visited} pixels; left out: {left}; kept from "
            f"the picture before: {', '.join(sorted(report.reused)) or 'nothing'}"
        )
    lines.append(f"{1000 * statistics.median(seconds):.1f} ms a frame (median of {len(seconds)})")
    return "".join(f"{line}\n" for line in lines)


if __name__ == "__main__":
    run_command(main)
