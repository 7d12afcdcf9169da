"""Contract-test cases: teachers with random weights, for each kind of target."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from framework.configuration.assembly import Resolved, build_predictor
from framework.configuration.description import Description
from framework.configuration.loading import PREFIX
from framework.configuration.schema import resolve
from framework.storage import checkpoints
from framework.target import Target
from framework.testing.plain import LENGTH
from framework.testing.rows import ANGLE, CLASSES, REALS, ObjectiveRow

FOLDER = TemporaryDirectory()
DRAWN: dict[str, str] = dict.fromkeys(
    ("order does not matter", "a mean over samples"),
    "the teacher draws other targets for each row of a batch",
)


def write_teacher(
    name: str,
    target: Target,
    head: str | dict[str, Any],
    members: int | None = 3,
    shape: tuple[int, ...] = (LENGTH,),
    **described: Any,
) -> str:
    """Write the checkpoint of an ensemble with random weights; return its path.

    Args:
        name: name of the file.
        target: the target.
        head: density head.
        members: number of members; None for a single model.
        shape: shape of an input.
        described: further fields of the `Description` that the checkpoint stores.
    """
    config: Resolved = {
        "data": {"name": "moons", "data_seed": 0},
        "density_head": resolve("density_head", head),
        "encoder": [resolve("encoder", {"name": "mlp", "widths": [8]})],
        "uncertainty": []
        if members is None
        else [resolve("uncertainty", {"name": "ensemble", "members": members})],
        "objective": [],
        "metric": [],
        "outliers": None,
    }
    predictor = build_predictor(config, target, shape, 0)
    description = Description(config, target, shape, (), True, **described)
    weights = {PREFIX + key: value for key, value in predictor.state_dict().items()}
    file = Path(FOLDER.name) / f"{name}.ckpt"
    checkpoints.write({"framework": description.stored(), "state_dict": weights}, file)
    return str(file)


CLASS_TEACHER, ANGLE_TEACHER, REAL_TEACHER = (
    write_teacher(name, target, head)
    for name, target, head in (
        ("classes", CLASSES, "categorical"),
        ("angle", ANGLE, "von_mises"),
        ("reals", REALS, "gaussian"),
    )
)
ROWS = {
    "distillation": (
        ObjectiveRow("classes", CLASSES, {"teacher": CLASS_TEACHER}),
        ObjectiveRow("one angle", ANGLE, {"teacher": ANGLE_TEACHER, "draws": 4}, leave_out=DRAWN),
        ObjectiveRow("reals", REALS, {"teacher": REAL_TEACHER, "weight": 0.5}, leave_out=DRAWN),
    )
}
