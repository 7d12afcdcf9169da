"""Data sets `registration` (scans of synthetic people) and `faust`, whose target is all vertices of each body."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from framework.bodies.body import BodyModel
from framework.bodies.people import People, load_body
from framework.configuration.paths import FilePath
from framework.data import Splits
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.geometry import clouds
from framework.geometry.meshes import read, stream
from framework.storage.generated import read_mark
from plugins.data.registration.faust import SUBJECTS, Scan, read_registration, scans
from plugins.data.registration.faust_generator import people_root
from plugins.data.registration.scanned_bodies import Bodies, normalise_scans, target_of
from plugins.data.registration.scanner import KINDS, Kinds, Scanner
from plugins.data.registration.scans import Scans

VERSION = 1
"""Version of the random draws, part of the fingerprint; increase it if the draws change."""
Size = Annotated[int, Field(ge=1, le=10_000_000)]
Points = Annotated[int, Field(ge=100, le=1_000_000)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Subjects = Annotated[list[Annotated[int, Field(ge=0, lt=SUBJECTS)]], Field(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Number of bodies in each split."""

    train: Size = 48_000
    validation: Size = 400
    test: Size = 1_000


class Registration(Bodies):
    """Synthetic scans of people of random shape and pose; the target is every vertex of the body (thesis §6.5.2).

    A random adult is sampled (`framework.bodies.people`), posed by linear blend skinning, and scanned by a simulated
    scanner (`plugins.data.registration.scanner`). No scan is stored: a sample depends only on the settings, its split
    and its number in the split, and is computed when it is fetched.

    Args:
        sizes: numbers of bodies of the splits.
        scanner, kinds: settings of every scan, and the shares of the kinds of scans.
        body: file of a body model of the SMPL family (.npz, .pkl); None: the default body, extracted on first use.
        shape_spread: standard deviation of the first ten shape coefficients of a body from a file.
        data_seed: seed of the draws, independent of the seed of the run.

    Raises:
        DataError: the body is not available or cannot be read.
    """

    bibtex = "prokudin2019efficient, bregier2026anny"

    def __init__(
        self,
        *,
        sizes: Sizes,
        scanner: Scanner,
        kinds: Kinds,
        body: FilePath | None = None,
        shape_spread: Annotated[float, Field(ge=0, le=5, allow_inf_nan=False)] = 1.0,
        data_seed: Seed = 0,
    ) -> None:
        self.sizes = asdict(sizes)
        self.scanner = scanner
        self.kinds = kinds
        self.body = body
        self.shape_spread = shape_spread
        self.data_seed = data_seed

    def prepare(self) -> None:
        self.people = People(*load_body(self.body), self.shape_spread)
        self.model = BodyModel(self.people.body)
        self.target = target_of(len(self.people.body.template))
        self.input_shape = (self.scanner.points, 3)
        self.groups = KINDS
        self.synthetic = True
        self.skipped = 0
        self._scans = [self._draw_split(split) for split in range(len(self.sizes))]
        self._splits = Splits(*self._scans)

    def _draw_split(self, split: int) -> Scans:
        name, seed = Splits._fields[split], (self.data_seed, split)
        random = np.random.default_rng(seed)
        people = self.people.draw(self.sizes[name], random)
        kind = torch.from_numpy(random.choice(len(KINDS), self.sizes[name], p=self.kinds.shares()))
        # float16 rounds by a quarter of a millimetre, too little to matter; all training targets may be kept at once
        precision = torch.float16 if name == "train" else torch.float32
        return Scans(self.model, people, kind, self.scanner, seed, precision)

    def cloud(self, file: Path) -> Tensor:
        return torch.from_numpy(read(file).vertices).float()

    def fingerprint(self) -> Mapping[str, str]:
        digest = hashlib.sha256(np.ascontiguousarray(self.people.body.template).tobytes())
        for split in self._scans:
            for values in (split.shape, split.pose, split.kind):
                digest.update(values.numpy().tobytes())
        return {
            "root": "generated",
            "version": f"registration {VERSION}",
            "body": self.people.body.source,
            "scanner": str(self.scanner),
            "data_seed": str(self.data_seed),
            **{name: str(size) for name, size in self.sizes.items()},
            "sha256": digest.hexdigest(),
        }


class Faust(Bodies):
    """FAUST's training scans and their registrations, split by person (Bogo et al. 2014).

    An input is a set of points drawn from a scan's vertices, and the target is the registration's vertices. The batch
    field "subject" (batch,) is the number of the person, 0 to 9. The scans of FAUST's own test set have no
    registrations; they are for `mode=predict` and for plugins.data.registration.correspond.

    Args:
        root: the folder that holds `training` (and `test`); None: people are generated in its layout.
        body: file of the body model of generated people (.npz, .pkl); None: the default body.
        points: number of points of a cloud; scans have some 170,000.
        validation, test: people of these splits; all others are for training.
        data_seed: seed of the choice of points, independent of the seed of the run.

    Raises:
        DataError: a scan has no registration or a registration no scan, a file cannot be read, registrations are of
            different meshes, or a split has no scans.
    """

    bibtex = "bogo2014faust"

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        body: FilePath | None = None,
        points: Points = 10_000,
        validation: Subjects = [7],  # noqa: B006 - never written
        test: Subjects = [8, 9],  # noqa: B006 - never written
        data_seed: Seed = 0,
    ) -> None:
        self.root, self.body = root, body
        self.points = points
        self.people = (set(validation), set(test))
        self.data_seed = data_seed

    def check_files(self) -> None:
        if self.root is not None:
            read_registration(scans(Path(self.root).expanduser())[0])

    def prepare(self) -> None:
        folder = people_root(self.body) if self.root is None else Path(self.root).expanduser()
        scans_found = scans(folder)
        first, self.faces = read_registration(scans_found[0])
        self.target = target_of(len(first))
        self.input_shape = (self.points, 3)
        self.groups = ("scans",)
        self.synthetic = read_mark(folder) is not None
        self.skipped = 0
        validation, test = self.people
        if both := validation & test:
            raise DataError(
                f"data.validation and data.test both name the people {sorted(both)}; expected each person in one "
                "split. Change one of the two lists."
            )
        subjects = {scan.subject for scan in scans_found}
        people = (subjects - validation - test, validation, test)
        for name, some in zip(Splits._fields, people, strict=True):
            if not some & subjects:
                raise DataError(
                    f"{folder}: there is no scan for the {name} split; the folder has the people {sorted(subjects)}. "
                    "Set data.validation and data.test so that every split has a scan."
                )
        self._digest = hashlib.sha256()
        tables = ([scan for scan in scans_found if scan.subject in some] for some in people)
        self._splits = Splits(*(self._table(some, len(first)) for some in tables))

    def _table(self, some: Sequence[Scan], vertices: int) -> Fields:
        inputs, targets = [], []
        for scan in some:
            mesh, _ = read_registration(scan, vertices)
            inputs.append(self.cloud(scan.scan))
            targets.append(torch.from_numpy(mesh).float())
            self._digest.update(f"{scan.number}".encode() + mesh.tobytes())
        return Fields(
            **normalise_scans(clouds.pad(inputs), torch.stack(targets)),
            subject=torch.tensor([scan.subject for scan in some]),
            group=torch.zeros(len(some), dtype=torch.int64),
            index=torch.arange(len(some)),
        )

    def cloud(self, file: Path) -> Tensor:
        """Return at most `points` vertices of a scan, metres, float32.

        If the scan has more vertices, they are drawn without replacement; the draw depends only on the name of the file
        and on `data_seed`.
        """
        vertices = read(file).vertices
        if len(vertices) > self.points:
            chosen = stream(self.data_seed, file.name).choice(len(vertices), self.points, replace=False)
            vertices = vertices[np.sort(chosen)]
        return torch.from_numpy(vertices).float()

    def fingerprint(self) -> Mapping[str, str]:
        return {
            "root": self.root or "generated",
            "version": "FAUST training",
            "points": str(self.points),
            "data_seed": str(self.data_seed),
            **{name: str(len(split)) for name, split in self._splits._asdict().items()},
            "sha256": self._digest.hexdigest(),
        }
