"""`python -m plugins.renderer.rasterizer <scene>` draws a scene file as an image or as an animation around it."""

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
from framework.scenes import pictures, turntable
from framework.scenes.parts import Axis
from framework.scenes.scene_files import UPWARDS, read
from framework.storage.commands import run_command
from framework.storage.limits import MOST_SAMPLES
from framework.storage.progress import track_progress
from plugins.renderer.rasterizer.renderer import Rasterizer

EXAMPLE = """
--camera names a JSON or YAML file with an exact camera in OpenCV's convention: a point X of the scene is seen at
pixel (fx x/z + cx, fy y/z + cy), where (x, y, z) = R X + t. Pixel centres lie at whole numbers; x points right, y
down and z forward.
  {"K": [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
   "t": [0, 0, 2], "size": [640, 480]}

examples:
  python -m plugins.renderer.rasterizer chair.glb --azimuth 40 --out chair.png
  python -m plugins.renderer.rasterizer chair.glb --turntable 60 --out chair.gif
  python -m plugins.renderer.rasterizer chair.glb --camera camera.json --channel depth --out depth.npy
"""
DEFAULT_VIEW = {
    "azimuth": 30.0,
    "elevation": 15.0,
    "tilt": 0.0,
    "distance": "auto",
    "fov": 40.0,
    "size": (480, 640),
}
"""Default view, used without a camera file.

Angles and field of view are in degrees, the distance is in metres, the size in pixels.
"""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a mistake in one sentence, without printing the usage first."""

    def error(self, message: str) -> NoReturn:
        message = shorten(message)
        if message.startswith("unrecognized arguments: "):
            message += "." + did_you_mean(message.split()[2].partition("=")[0], self._option_string_actions)
        raise ConfigError(f"{message}{'' if message[-1] in '.?' else '.'} --help lists all options.")


def number_parser(
    low: float | int, high: float | int, unit: str, *, kind: type = float
) -> Callable[[str], float | int]:
    """Return a function that parses a number and checks that it lies between `low` and `high`.

    Args:
        low: smallest allowed number.
        high: largest allowed number.
        unit: text that follows the range in the error message, such as " metres".
        kind: int for whole numbers, float for any numbers.
    """

    def parse(text: str) -> float | int:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            wanted = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(
                f"got {quote(text)}, expected {wanted} from {low:g} to {high:g}{unit}"
            )
        return value

    return parse


def parse_distance(text: str) -> float | int | str:
    """Parse a distance in metres, or "auto"."""
    return text if text == "auto" else number_parser(1e-6, 1e9, " (metres), or auto")(text)


def parse_size(text: str) -> tuple[int, int]:
    """Parse a text such as 640x480 and return (height, width)."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(
        side.isdecimal() and 1 <= int(side) <= turntable.LONGEST_SIDE for side in sides
    ):
        raise argparse.ArgumentTypeError(
            f"got {quote(text)}, expected WIDTHxHEIGHT in pixels, each from 1 to {turntable.LONGEST_SIDE}, such as "
            "640x480"
        )
    return int(sides[1]), int(sides[0])


def parse_color(text: str) -> tuple[int, int, int] | None:
    """Parse a colour such as "white" or "#20a0ff" into (red, green, blue) from 0 to 255; None for "transparent"."""
    if text == "transparent":
        return None
    try:
        red, green, blue, *_ = ImageColor.getrgb(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"got {quote(text)}, expected a colour such as white or #20a0ff, or transparent."
            + did_you_mean(text, ["transparent", *ImageColor.colormap])
        ) from None
    return red, green, blue


def parse_channel(text: str) -> str:
    """Check that the renderer can draw the channel named `text`, and return the name."""
    known = sorted(Rasterizer.channels)
    if text not in known:
        near = did_you_mean(text, known)
        raise argparse.ArgumentTypeError(
            f"got {quote(text)}, expected one of {', '.join(known)}.{near}".rstrip(".")
        )
    return text


def build_parser() -> Parser:
    """Return the parser of the command's arguments."""
    parser = Parser(
        prog="python -m plugins.renderer.rasterizer",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add(
        "scene",
        type=Path,
        help=f"a file whose name ends in {', '.join(UPWARDS)}; its texture files must lie beside it",
    )
    add(
        "--out",
        type=Path,
        help=".png, .gif, .mp4 or .npy; default: outputs/<scene>.png, or .gif with --turntable",
    )
    angle = number_parser(-3600, 3600, " degrees")
    add("--azimuth", type=angle, help="degrees around the subject, 0 sees its front; default: 30")
    add("--elevation", type=angle, help="degrees above the horizon; default: 15")
    add("--tilt", type=angle, help="degrees by which the camera rolls; default: 0")
    add(
        "--distance",
        type=parse_distance,
        help="metres from the subject's centre; default: auto, so that the whole subject is visible",
    )
    add("--fov", type=number_parser(0.1, 170, " degrees"), help="degrees from top to bottom; default: 40")
    add("--size", type=parse_size, help="WIDTHxHEIGHT in pixels; default: 640x480")
    add("--up", choices=("y", "z"), help="the subject's vertical axis; default: y, but z for .off and .stl")
    add("--camera", type=Path, help="a file with K, R, t and size, instead of the options above; see below")
    add(
        "--turntable",
        type=number_parser(2, 3600, "", kind=int),
        help="number of frames of an animation once around the subject",
    )
    add(
        "--rate",
        type=number_parser(1, 50, " frames per second", kind=int),
        default=25,
        help="frames per second; default: 25",
    )
    add(
        "--background",
        type=parse_color,
        default="gainsboro",
        help="a colour, or transparent (.png); default: gainsboro",
    )
    add(
        "--supersampling",
        type=number_parser(1, 16, "", kind=int),
        default=3,
        help="samples per pixel along each axis; default: 3",
    )
    add(
        "--channel",
        type=parse_channel,
        default="color",
        help=f"one of {', '.join(sorted(Rasterizer.channels))}",
    )
    add(
        "--shade",
        action=argparse.BooleanOptionalAction,
        help="light every object from the camera; default: only objects with a single colour",
    )
    add(
        "--report",
        action="store_true",
        help="print which faces the renderer left out, and the milliseconds per frame",
    )
    return parser


def main(arguments: list[str]) -> None:
    """Draw a scene file and write the image; print the image's path to stdout, and notes and the report to stderr.

    Raises:
        UserError: the request cannot be carried out, or a file cannot be read.
        OSError: the output file cannot be written.
    """
    options = build_parser().parse_args(arguments)
    out = options.out or Path(
        "outputs", options.scene.stem + (".png" if options.turntable is None else ".gif")
    )
    check_arguments(options, out)
    subject = read(options.scene)
    for note in subject.notes:
        sys.stderr.write(f"note: {options.scene}: {note}\n")
    if options.channel == "uv" and subject.scene.texture is None:
        raise DataError(
            f"{options.scene}: the scene has no texture, but --channel uv requires one. Choose another --channel."
        )
    up = options.up or subject.up
    sphere = turntable.bounding_sphere(subject.scene)
    camera = make_camera(options, sphere, up)
    check_size(camera, options, out)
    frame_count = options.turntable or 1
    cameras = track_progress(
        turntable.circle_cameras(camera, sphere.centre, up, frame_count), "drawing", frame_count, "frames"
    )
    renderer = Rasterizer(supersampling=options.supersampling if options.channel == "color" else 1)
    seconds: list[float] = []
    stage = pictures.prepare_stage(subject, options.shade if options.channel == "color" else False)
    exact = out.suffix.lower() == ".npy"

    def frames() -> Iterator[NDArray]:
        for camera_at_frame in cameras:
            scene = stage.lit_scene(camera_at_frame)
            start = time.perf_counter()
            try:
                # the first drawing compiles the kernels, so it is not timed
                if options.report and not seconds:
                    Rasterizer(supersampling=renderer.supersampling)(scene, (options.channel,))
                    start = time.perf_counter()
                rendered = renderer(scene, (options.channel,))[options.channel]
            except ValueError as error:  # the message is a sentence about what the renderer cannot draw
                raise DataError(f"{options.scene}: {error}") from error
            seconds.append(time.perf_counter() - start)
            if options.channel == "color" and not exact:
                yield pictures.color_image(rendered, options.background)
            else:
                yield rendered.numpy() if exact else pictures.INTEGER_IMAGES[options.channel](rendered)

    with torch.no_grad():
        pictures.write_frames(out, frames(), options.rate)
    if renderer.report is not None and not renderer.report.drawn_faces:
        sys.stderr.write(f"note: {options.scene}: no face of the scene is visible in the last image.\n")
    if options.report:
        sys.stderr.write(format_report(renderer.report, seconds))
    sys.stdout.write(f"{out}\n")


def check_arguments(options: argparse.Namespace, out: Path) -> None:
    """Check the arguments, before any file is read.

    Raises:
        ConfigError: two arguments contradict each other, or an argument does not fit the type of the file `out`.
    """
    suffix = out.suffix.lower()
    if suffix not in pictures.SUFFIXES:
        raise ConfigError(
            f"got --out {out}, expected a file name that ends in {', '.join(pictures.SUFFIXES)}."
            f"{did_you_mean(suffix, pictures.SUFFIXES)}"
        )
    if out.is_dir():
        raise ConfigError(f"--out {out} is a folder. Give the name of a file.")
    contradicting = [name for name in DEFAULT_VIEW if getattr(options, name) is not None]
    if options.camera is not None and contradicting:
        raise ConfigError(
            f"got both --{contradicting[0]} and --camera, whose file determines the whole view. Give only one of them."
        )
    is_animation = suffix in (".gif", ".mp4")
    if is_animation and options.turntable is None:
        raise ConfigError(
            f"--out {out} is an animation, which requires --turntable with a number of frames, such as --turntable 60."
        )
    if suffix == ".png" and options.turntable is not None:
        raise ConfigError(f"got --turntable, but --out {out} holds a single image. Use .gif, .mp4 or .npy.")
    if options.background is None and (suffix != ".png" or options.channel != "color"):
        raise ConfigError("--background transparent is possible only for --channel color and a .png file.")
    if is_animation and options.channel in ("depth", "face"):
        raise ConfigError(
            f"an animation cannot hold the numbers of --channel {options.channel}. Use .npy, or .png without "
            "--turntable."
        )
    if suffix != ".npy" and options.channel != "color" and options.channel not in pictures.INTEGER_IMAGES:
        raise ConfigError(f"an image file cannot hold --channel {options.channel}. Use .npy.")
    if suffix == ".mp4":
        pictures.find_ffmpeg()


def make_camera(options: argparse.Namespace, sphere: turntable.BoundingSphere, up: Axis) -> Camera:
    """Return the camera from the file `options.camera`; without a file, the camera that the other arguments describe.

    Args:
        options: arguments of the command.
        sphere: sphere around the subject, which the camera looks at.
        up: the scene's vertical axis.
    """
    if options.camera is not None:
        return turntable.read_camera(options.camera)
    chosen = {name: getattr(options, name) for name in DEFAULT_VIEW}
    chosen = {name: DEFAULT_VIEW[name] if value is None else value for name, value in chosen.items()}
    angles = math.radians(chosen["azimuth"]), math.radians(chosen["elevation"]), math.radians(chosen["tilt"])
    far = None if chosen["distance"] == "auto" else chosen["distance"]
    return turntable.look_at(sphere, up, angles, far, math.radians(chosen["fov"]), chosen["size"])


def check_size(camera: Camera, options: argparse.Namespace, out: Path) -> None:
    """Check that the image is not too large, and that the format of the file `out` supports its size.

    Raises:
        ConfigError: the image has too many samples, or is a video whose width or height is odd.
    """
    samples = camera.height * camera.width * options.supersampling**2
    if samples > MOST_SAMPLES:
        raise ConfigError(
            f"got {camera.width}x{camera.height} pixels with {options.supersampling}x{options.supersampling} samples "
            "each; at most "
            f"{MOST_SAMPLES} samples are possible. Choose a smaller --size or --supersampling."
        )
    if out.suffix.lower() == ".mp4" and (camera.height % 2 or camera.width % 2):
        raise ConfigError(
            f"got {camera.width}x{camera.height} pixels, but an .mp4 requires an even width and height. Change --size."
        )


def format_report(report: Report | None, seconds: list[float]) -> str:
    """Format the report of the last image and the median time per frame as text."""
    lines = []
    if report is not None:
        left = ", ".join(f"{count} {reason}" for reason, count in report.left_out.items()) or "none"
        lines.append(
            f"{report.drawn_faces} of {report.faces} faces drawn, in {report.visited} pixels; left out: {left}; reused "
            f"from the previous image: {', '.join(sorted(report.reused)) or 'nothing'}"
        )
    lines.append(f"{1000 * statistics.median(seconds):.1f} ms per frame (median of {len(seconds)})")
    return "".join(f"{line}\n" for line in lines)


if __name__ == "__main__":
    run_command(main)
