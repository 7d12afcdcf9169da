"""Contract-test cases: coarse grids, with log-densities computed cell by cell in NumPy."""

from collections.abc import Iterator

import numpy as np
import torch
from scipy import special
from scipy.spatial.transform import Rotation

from framework.density_head import DensityHead
from framework.geometry.rotation_grid import cell_of, centres
from framework.heads.rotations import ANGLES
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.implicit_pdf.head import LARGEST_FEATURE, ImplicitPDFHead

TARGET = Target("angle", ANGLES)


def cases(head: DensityHead) -> Iterator[Case]:
    """Yield ordinary raw parameters and large ones, with the log-density by SciPy's rotations and NumPy."""
    assert isinstance(head, ImplicitPDFHead)
    generator = torch.Generator().manual_seed(7)
    ordinary = torch.randn(4, head.size, generator=generator).double()
    value = (1.5 * torch.randn(4, 3, generator=generator)).double()
    weights = [part.detach().numpy() for part in head.body.parameters()]
    tilt_elevation_azimuth = centres(head.cells).numpy()[:, ::-1] * [1, 1, -1] - [0, np.pi / 2, 0]
    matrix = Rotation.from_euler("ZXZ", tilt_elevation_azimuth).as_matrix().reshape(head.cells, 9)
    phase = (np.pi * matrix[..., None] * 2.0 ** np.arange(head.frequencies)).reshape(head.cells, -1)
    first = np.concatenate([np.sin(phase), np.cos(phase)], 1) @ head.of_rotation.weight.detach().numpy().T
    for name, raw in {"ordinary": ordinary, "large": 64 * ordinary}.items():
        log_prob = []
        for row, angles in zip(raw, value, strict=True):
            layer = np.maximum(LARGEST_FEATURE * np.tanh(row.numpy() / LARGEST_FEATURE) + first, 0)
            for weight, bias in zip(weights[:-1:2], weights[1::2], strict=True):
                layer = np.maximum(layer @ weight.T + bias, 0)
            logits = (layer @ weights[-1].T)[:, 0]
            cell = int(cell_of(angles, head.cells))
            volume = np.log(np.abs(np.cos(angles[1].item())) / (8 * np.pi**2))
            log_prob.append(logits[cell] - special.logsumexp(logits) + np.log(head.cells) + volume)
        yield Case(name, raw, value, torch.tensor(log_prob, dtype=torch.float64))


COARSE = {"hidden": 8, "layers": 1, "frequencies": 2, "training_cells": 72, "cells": 576}
JUMPS = "the density jumps between cells, which no fixed quadrature resolves; test_implicit_pdf.py checks it"
ROWS = {
    "implicit_pdf": (
        HeadRow(
            "576 cells",
            TARGET,
            COARSE,
            cases=cases,
            # the adaptive quadrature stops at a number of boxes; draws check the integral without this error
            limits={"integral": 1e-3},
            leave_out={
                "marginals": JUMPS,
                "mode": "the mode is the likeliest rotation; the highest point in the chart differs, because of cos e",
                "tempered: power": "only the density of rotations is raised to the power, not the chart's cos e",
                "loss is least for its own density": "the loss compares the density at a label with random rotations",
            },
        ),
    )
}
