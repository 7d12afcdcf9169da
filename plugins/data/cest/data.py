"""Data set of Z-spectra of a brain and fitted Lorentzian lines; framework.data describes the contract."""

import hashlib
import io
import logging
import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath
from framework.data import Batch, Data, Mapped, Splits
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.spectra.fit import fit
from framework.spectra.offsets import offsets_of
from framework.spectra.spectrum import COUNT, Parameters, Preset, spectrum
from framework.storage.arrays import archive
from framework.storage.cache import folder
from framework.storage.files import write_whole
from framework.storage.generated import generated, read_mark
from framework.target import Target
from plugins.data.cest.resampling import resampled
from plugins.data.cest.spectrum_picture import curve
from plugins.data.cest.volumes import SUFFIXES, Volume, read_volume

NotNegative = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
GENERATED, FITTED = "1", "3"
"""Version of the generator, and of the fit whose results are kept in the cache."""
FILE = "brain.npz"
"""Name of the volume in a folder."""
CYCLE = (0, 0, 1, 0, 0, 2)
"""Splits of the bands of rows in turn: 0 training, 1 validation, 2 test."""
_log = logging.getLogger(__name__)


class Slice(NamedTuple):
    """Spectra and fitted lines of voxels.

    Attributes:
        spectra: (voxel, offset) float32, at the model's offsets.
        lines: (voxel, p) float64, all fitted parameters; the first of them are the target.
        place: (voxel, 3), index of the voxel in the volume.
        region: (voxel,), number of the region.
    """

    spectra: Tensor
    lines: Tensor
    place: Tensor
    region: Tensor


class CEST(Data, Mapped):
    """Z-spectra of a volume's voxels; the target is the Lorentzian lines fitted by least squares (thesis §4.1).

    Splits are bands of `band` neighbouring rows (the first axis), in turn training, training, validation, training,
    training, test. The first row of a band is left out where the band before belongs to another split, so that no voxel
    has a neighbour in another split. Fits are kept in the cache. Batches also hold "place", (batch, 3), the index of
    the voxel, and "lines", (batch, p), all fitted parameters.

    Args:
        root: a file, see volumes.py, or a folder with brain.npz; None to generate a slice.
        preset: "ten" numbers, amplitude and width of five pools, or "fifteen", with their centres.
        offsets: offsets at which the model reads spectra, ppm, ascending; None for `framework.spectra.offsets.OFFSETS`.
            Spectra at other offsets are resampled.
        band: number of rows of a band.
        noise: greatest standard deviation of the noise that is added to training spectra; it is drawn for each
            spectrum.
        shift: greatest shift of a training spectrum's lines, ppm; a fitted centre of water is shifted too.
        side: side of the generated slice, voxels.
        data_seed: seed of the generated slice.
        unreadable: treatment of a bad file in a folder for prediction: list it and leave it out, or refuse the folder.
    """

    bibtex = """@article{glang2019deepcest,
  author  = {Glang, Felix and Deshmane, Anagha and Prokudin, Sergey and Martin, Florian and Herz, Kai and others},
  title   = {{DeepCEST} {3T}: Robust {MRI} parameter determination and uncertainty quantification with neural networks},
  journal = {Magnetic Resonance in Medicine},
  year    = {2019}
}"""
    title = "cest"
    suffixes = SUFFIXES
    companions = (".mask.nii.gz", ".mask.nii", ".offsets.txt")

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        preset: Preset = "ten",
        offsets: list[float] | None = None,
        band: Annotated[int, Field(ge=2, le=1000)] = 6,
        noise: NotNegative = 0.02,
        shift: NotNegative = 0.1,
        side: Annotated[int, Field(ge=24, le=512)] = 64,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
        unreadable: Literal["skip", "error"] = "skip",
    ) -> None:
        self.root, self.given = root, offsets
        self.preset: Preset = preset
        self.band, self.noise, self.shift = band, noise, shift
        self.side, self.data_seed = side, data_seed
        self.varies = noise > 0 or shift > 0
        self.unreadable = unreadable
        self.skipped = 0

    @cached_property
    def offsets(self) -> tuple[float, ...]:
        """Offsets at which the model reads spectra, ppm."""
        return offsets_of(self.given)

    @property
    def wanted(self) -> Parameters:
        """Parameters that are fitted to each spectrum."""
        return Parameters.of(self.preset)

    def prepare(self) -> None:
        file, self.synthetic = self._file()
        volume = read_volume(file)
        self.skipped = volume.dropped
        if volume.dropped:
            _log.warning("%s: %d voxels with a number that is not finite are left out.", file, volume.dropped)
        spectra = torch.from_numpy(
            resampled(volume.spectra, volume.offsets, self.offsets, str(file)).astype(np.float32)
        )
        found = Slice(
            spectra, self._fits(spectra), torch.from_numpy(volume.place), torch.from_numpy(volume.region)
        )
        self.groups = volume.regions
        self.remarks = _remarks(volume, self.offsets)
        self.input_shape = (len(self.offsets),)
        self.columns = tuple(f"{offset:+.4f} ppm" for offset in self.offsets)
        self._splits = Splits(*(self._split(found, number, file) for number in range(3)))
        training = self._splits.train.fields["target"].double()  # type: ignore[attr-defined]
        self.target = Target(
            "real",
            self.wanted.target,
            tuple(training.mean(0).tolist()),
            tuple(training.std(0, correction=0).clamp(min=1e-6).tolist()),
        )
        self._digest = _digest(spectra, found.lines.float())

    def _file(self) -> tuple[Path, bool]:
        if self.root is not None:
            place = Path(self.root).expanduser()
            file = place / FILE if place.is_dir() else place
            return file, file.parent.is_dir() and read_mark(file.parent) is not None
        from plugins.data.cest.generator import write_slice

        asked = {"side": self.side, "noise": 0.01, "shift": 0.08, "data_seed": self.data_seed}
        name = f"{GENERATED}_{self.side}_{self.data_seed}"
        mark = {"plugin": "cest", "version": GENERATED, **asked}
        return generated(folder("cest") / name, mark, partial(write_slice, **asked)) / FILE, True

    def _fits(self, spectra: Tensor) -> Float[Tensor, "voxel p"]:
        """Return the fits, from the cache if they are kept there."""
        key = hashlib.sha256(
            spectra.numpy().tobytes() + repr((FITTED, self.wanted, self.offsets)).encode()
        ).hexdigest()[:24]
        kept = folder("cest_fits") / f"{key}.npz"
        if kept.is_file():
            try:
                return torch.from_numpy(archive(kept.read_bytes())["parameters"])
            except Exception:
                _log.warning("%s cannot be read; the spectra are fitted again.", kept)
        found = fit(spectra, torch.tensor(self.offsets), self.wanted).parameters
        stream = io.BytesIO()
        np.savez(stream, parameters=found.numpy())
        write_whole(kept, stream.getvalue())
        return found

    def _split(self, found: Slice, number: int, file: Path) -> Fields:
        row = found.place[:, 0]
        cycle = torch.tensor(CYCLE)
        first = row - row.min()
        band = first // self.band
        split = cycle[band % len(CYCLE)]
        edge = (first % self.band == 0) & (band > 0) & (split != cycle[(band - 1) % len(CYCLE)])
        chosen = (split == number) & ~edge
        if not chosen.any():
            raise DataError(
                f"{file}: {int(row.max() - row.min()) + 1} rows of voxels in bands of {self.band} leave nothing for "
                f"{Splits._fields[number]}; wanted {len(CYCLE)} bands. Choose a smaller data.band."
            )
        return Fields(
            input=found.spectra[chosen],
            target=found.lines[chosen, : self.wanted.target_count].float(),
            lines=found.lines[chosen].float(),
            group=found.region[chosen],
            place=found.place[chosen],
            index=torch.arange(int(chosen.sum())),
        )

    def splits(self) -> Splits:
        return self._splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        if not files:
            raise DataError("no file was given; wanted volumes of Z-spectra (.mat, .npz, .nii).")
        found = []
        for file in files:
            volume = read_volume(Path(file))
            found.append(resampled(volume.spectra, volume.offsets, self.offsets, str(file)))
        spectra = torch.from_numpy(np.concatenate(found).astype(np.float32))
        return Fields(input=spectra, index=torch.arange(len(spectra)))

    def write_maps(self, file: Path, point: Tensor, deviation: Tensor, folder: Path) -> Sequence[Path]:
        """Write the maps of the predictions for a volume, and return the files."""
        from plugins.data.cest.maps import write_maps

        return write_maps(file, self.wanted.target, point, deviation, folder, synthetic=self.synthetic)

    def augment(self, batch: Batch) -> Batch:
        """Return a batch with random noise and a random B0 shift of the lines; the fit's residuals are not shifted.

        Strength of noise and shift are cubes of uniform numbers times the greatest value, so that most spectra stay
        nearly unchanged and some change strongly.
        """
        spectra, target, lines = batch["input"], batch["target"], batch["lines"]
        if self.shift:
            moved = self.shift * (2 * torch.rand(len(spectra), device=spectra.device) - 1) ** 3
            offsets, before = torch.tensor(self.offsets).to(spectra), lines
            lines = lines.clone()
            lines[:, 2 * COUNT] += moved
            spectra = spectra + spectrum(lines, offsets) - spectrum(before, offsets)
            target = lines[:, : target.shape[1]]
        if self.noise:
            strength = self.noise * torch.rand(len(spectra), 1, device=spectra.device) ** 3
            spectra = spectra + strength * torch.randn_like(spectra)
        return {**batch, "input": spectra, "target": target, "lines": lines}

    def fingerprint(self) -> Mapping[str, str]:
        return {
            "root": str(self.root or "generated"),
            "version": f"cest {GENERATED}.{FITTED}",
            "preset": self.preset,
            "band": str(self.band),
            "left_out": str(self.skipped),
            **{name: str(len(part)) for name, part in zip(Splits._fields, self._splits, strict=True)},  # type: ignore[arg-type]
            "sha256": self._digest,
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return curve(inputs.detach().cpu().double().numpy())


def _remarks(volume: Volume, offsets: Sequence[float]) -> tuple[str, ...]:
    """Return sentences on what of a volume is left out or resampled."""
    said = []
    outside = math.prod(volume.shape) - len(volume.spectra) - volume.dropped
    if outside:
        said.append(f"left out: {outside} voxels outside the mask, or without a number")
    if volume.dropped:
        said.append(f"left out: {volume.dropped} voxels with a number that is not finite")
    if volume.unread:
        said.append(f"left out: {', '.join(volume.unread)} of the file")
    if len(volume.offsets) != len(offsets) or not np.allclose(volume.offsets, offsets):
        said.append(f"{len(volume.offsets)} offsets of the file, resampled at {len(offsets)}")
    return tuple(said)


def _digest(*tensors: Tensor) -> str:
    found = hashlib.sha256()
    for tensor in tensors:
        found.update(np.ascontiguousarray(tensor.numpy()).tobytes())
    return found.hexdigest()
