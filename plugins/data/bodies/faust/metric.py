"""Intra- and inter-subject correspondence error of registered meshes."""

from typing import ClassVar, Literal

import torch
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.errors import DataError
from framework.geometry.clouds import denormalised
from framework.metric import Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.data.bodies.faust.correspondence import correspondence

FIELDS = ("centre", "scale", "subject")


class CorrespondenceError(Metric):
    """Error of correspondences through predicted meshes, centimetres, over all ordered pairs of test scans (Table 6.4).

    `intra_cm` is of scans of one person, `inter_cm` of two people; the target is the true registration. Holds every
    predicted and true mesh until the end.

    Raises:
        ConfigError: the target is not real.
        DataError: a batch without "centre", "scale" or "subject".
    """

    bibtex = """@inproceedings{bogo2014faust,
  title = {{FAUST}: Dataset and Evaluation for {3D} Mesh Registration},
  author = {Bogo, Federica and Romero, Javier and Loper, Matthew and Black, Michael J.},
  booktitle = {IEEE Conference on Computer Vision and Pattern Recognition (CVPR)},
  year = {2014}
}"""
    columns: ClassVar[dict[str, str]] = {"intra_cm": "intra cm", "inter_cm": "inter cm"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "lower")
    registered: list[Tensor]
    truth: list[Tensor]
    subject: list[Tensor]

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="metric correspondence")
        for name in ("registered", "truth", "subject"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        missing = [name for name in FIELDS if name not in prediction.batch]
        if missing:
            raise DataError(
                f"metric correspondence reads {missing[0]!r}, which this data set does not give. Choose data=faust, or "
                "leave this metric out."
            )
        centre, scale, subject = (prediction.batch[name] for name in FIELDS)
        for name, mesh in (("registered", prediction.point), ("truth", prediction.target)):
            getattr(self, name).append(denormalised(mesh.unflatten(1, (-1, 3)), centre, scale))
        self.subject.append(subject)

    def compute(self) -> dict[str, Tensor]:
        if not sum(map(len, self.subject)):
            nothing = torch.tensor(torch.nan)
            return {"intra_cm": nothing, "inter_cm": nothing.clone()}
        registered, truth, subject = (
            dim_zero_cat(state) for state in (self.registered, self.truth, self.subject)
        )
        return correspondence(truth, registered, subject)._asdict()
