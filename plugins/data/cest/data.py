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
from framework.errors import DataError, count_of
from framework.spectra.fit import fit
from framework.spectra.offsets import offsets_of
from framework.spectra.spectrum import COUNT, Parameters, Preset, spectrum
from framework.storage.arrays import read_npz
from framework.storage.cache import folder
from framework.storage.files import write_whole
from framework.storage.generated import ensure_generated, read_mark
from framework.target import Target
from plugins.data.cest.resampling import resample
from plugins.data.cest.spectrum_picture import curve
from plugins.data.cest.volumes import SUFFIXES, Volume, read_volume

NotNegative = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
GENERATOR_VERSION, FIT_VERSION = "1", "3"
"""Version of the generator, and of the fit whose results are stored in the cache."""
FILE = "brain.npz"
"""Name of a volume's file in a folder."""
CYCLE = (0, 0, 1, 0, 0, 2)
"""Splits of consecutive bands, repeated over the volume: 0 training, 1 validation, 2 test."""
_log = logging.getLogger(__name__)


class Slice(NamedTuple):
    """Spectra and fitted lines of voxels.

    Attributes:
        spectra: Z of the voxels at the model's offsets, (voxel, offset) float32.
        lines: All fitted parameters, (voxel, p) float64; the first columns are the target.
        place: Index of each voxel in the volume, (voxel, 3).
        region: Index of each voxel's region among the groups, (voxel,).
    """

    spectra: Tensor
    lines: Tensor
    place: Tensor
    region: Tensor


class CEST(Data, Mapped):
    """Z-spectra of a volume's voxels; the target is the Lorentzian lines fitted by least squares (thesis §4.1).

    The volume is divided into bands of `band` neighbouring rows (the first axis). Of every six consecutive bands,
    the third is for validation, the sixth for the test, and the others are for training. If two neighbouring bands are
    in different splits, the first row of the second band is left out, so that no voxel has a neighbour in another
    split. Fits are stored in the cache. Batches also hold "place", (batch, 3), the index of the voxel, and "lines",
    (batch, p), all fitted parameters.

    Args:
        root: A volume (.mat, .npz, .nii or .nii.gz), or a folder with brain.npz; None to generate a slice.
        preset: "ten": the target is the amplitude and width of five pools. "fifteen": their centres too.
        offsets: Offsets at which the model reads spectra, ppm, ascending; None for `framework.spectra.offsets.OFFSETS`.
            Spectra at other offsets are resampled.
        band: Number of rows of a band.
        noise: Largest standard deviation of the noise that is added to training spectra; the standard deviation is
            drawn at random for each spectrum.
        shift: Largest shift of a training spectrum's lines, ppm; the fitted centre of water is shifted with them.
        side: Side of the generated slice, voxels.
        data_seed: Seed of the generated slice.
        unreadable: Treatment of a bad file in a folder for prediction. "skip" lists the file and leaves it out,
            "error" refuses the folder.
    """

    bibtex = "glang2019deepcest"
    title = "cest"
    suffixes = SUFFIXES
    companions = (".mask.nii.gz", ".mask.nii", ".offsets.txt")

    # More than eight parameters: each keyword is a config key that a user sets alone.
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
        self.root, self.configured_offsets = root, offsets
        self.preset: Preset = preset
        self.band, self.noise, self.shift = band, noise, shift
        self.side, self.data_seed = side, data_seed
        self.varies = noise > 0 or shift > 0
        self.unreadable = unreadable
        self.skipped = 0

    @cached_property
    def offsets(self) -> tuple[float, ...]:
        """Offsets at which the model reads spectra, ppm."""
        return offsets_of(self.configured_offsets)

    @property
    def parameters(self) -> Parameters:
        """Parameters that are fitted to each spectrum."""
        return Parameters.of(self.preset)

    def check_files(self) -> None:
        if self.root is not None:
            read_volume(self._file()[0])

    def prepare(self) -> None:
        file, self.synthetic = self._file()
        volume = read_volume(file)
        self.skipped = volume.dropped
        if volume.dropped:
            _log.warning(
                "%s: left out, because a number is not finite: %s.", file, count_of(volume.dropped, "voxel")
            )
        spectra = torch.from_numpy(
            resample(volume.spectra, volume.offsets, self.offsets, str(file)).astype(np.float32)
        )
        voxels = Slice(
            spectra, self._fit(spectra), torch.from_numpy(volume.place), torch.from_numpy(volume.region)
        )
        self.groups = volume.regions
        self.remarks = _remarks(volume, self.offsets)
        self.input_shape = (len(self.offsets),)
        self.columns = tuple(f"{offset:+.4f} ppm" for offset in self.offsets)
        self._splits = Splits(*(self._split(voxels, number, file) for number in range(3)))
        training = self._splits.train.fields["target"].double()  # type: ignore[attr-defined]
        self.target = Target(
            "real",
            self.parameters.target,
            tuple(training.mean(0).tolist()),
            tuple(training.std(0, correction=0).clamp(min=1e-6).tolist()),
        )
        self._digest = _digest(spectra, voxels.lines.float())

    def _file(self) -> tuple[Path, bool]:
        """Return the volume's file, and whether it was generated."""
        if self.root is not None:
            path = Path(self.root).expanduser()
            file = path / FILE if path.is_dir() else path
            return file, file.parent.is_dir() and read_mark(file.parent) is not None
        from plugins.data.cest.generator import write_slice

        settings = {"side": self.side, "noise": 0.01, "shift": 0.08, "data_seed": self.data_seed}
        name = f"{GENERATOR_VERSION}_{self.side}_{self.data_seed}"
        mark = {"plugin": "cest", "version": GENERATOR_VERSION, **settings}
        return ensure_generated(folder("cest") / name, mark, partial(write_slice, **settings)) / FILE, True

    def _fit(self, spectra: Tensor) -> Float[Tensor, "voxel p"]:
        """Return the fitted parameters of spectra; read them from the cache if they are stored there."""
        key = hashlib.sha256(
            spectra.numpy().tobytes() + repr((FIT_VERSION, self.parameters, self.offsets)).encode()
        ).hexdigest()[:24]
        cache_file = folder("cest_fits") / f"{key}.npz"
        if cache_file.is_file():
            try:
                return torch.from_numpy(read_npz(cache_file.read_bytes())["parameters"])
            except Exception:
                _log.warning("%s cannot be read; the spectra are fitted again.", cache_file)
        parameters = fit(spectra, torch.tensor(self.offsets), self.parameters).parameters
        stream = io.BytesIO()
        np.savez(stream, parameters=parameters.numpy())
        write_whole(cache_file, stream.getvalue())
        return parameters

    def _split(self, voxels: Slice, number: int, file: Path) -> Fields:
        """Return the voxels of split `number` (0 training, 1 validation, 2 test)."""
        row = voxels.place[:, 0]
        cycle = torch.tensor(CYCLE)
        first = row - row.min()
        band = first // self.band
        split = cycle[band % len(CYCLE)]
        edge = (first % self.band == 0) & (band > 0) & (split != cycle[(band - 1) % len(CYCLE)])
        chosen = (split == number) & ~edge
        if not chosen.any():
            raise DataError(
                f"{file}: {int(row.max() - row.min()) + 1} rows of voxels in bands of {self.band} rows leave no voxel "
                f"for the {Splits._fields[number]} split; {len(CYCLE)} bands are needed. Choose a smaller data.band."
            )
        return Fields(
            input=voxels.spectra[chosen],
            target=voxels.lines[chosen, : self.parameters.target_count].float(),
            lines=voxels.lines[chosen].float(),
            group=voxels.region[chosen],
            place=voxels.place[chosen],
            index=torch.arange(int(chosen.sum())),
        )

    def splits(self) -> Splits:
        return self._splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        if not files:
            raise DataError("No file was given. Give volumes of Z-spectra (.mat, .npz, .nii).")
        spectra_of_files = []
        for file in files:
            volume = read_volume(Path(file))
            spectra_of_files.append(resample(volume.spectra, volume.offsets, self.offsets, str(file)))
        spectra = torch.from_numpy(np.concatenate(spectra_of_files).astype(np.float32))
        return Fields(input=spectra, index=torch.arange(len(spectra)))

    def write_maps(self, file: Path, point: Tensor, deviation: Tensor, folder: Path) -> Sequence[Path]:
        """Write the maps of the predictions for a volume and return the paths of the files.

        `point` and `deviation`, (voxel, number), are the point predictions and standard deviations of the voxels of
        `file`, in the order in which `read_volume` returns them. The files are written to `folder`.
        """
        from plugins.data.cest.maps import write_maps

        return write_maps(file, self.parameters.target, point, deviation, folder, synthetic=self.synthetic)

    def augment(self, batch: Batch) -> Batch:
        """Return a batch with random noise, and with fitted lines that are shifted along the offsets at random.

        The shift imitates an error of the B0 field. A spectrum is the sum of its fitted lines and of the residuals of
        the fit; the residuals are not shifted. For each spectrum, the largest shift and the largest standard deviation
        of the noise are multiplied by the cube of a uniform random number. Most spectra therefore stay nearly
        unchanged, and some change strongly.
        """
        spectra, target, lines = batch["input"], batch["target"], batch["lines"]
        if self.shift:
            b0_shift = self.shift * (2 * torch.rand(len(spectra), device=spectra.device) - 1) ** 3
            offsets, fitted_lines = torch.tensor(self.offsets).to(spectra), lines
            lines = lines.clone()
            lines[:, 2 * COUNT] += b0_shift
            spectra = spectra + spectrum(lines, offsets) - spectrum(fitted_lines, offsets)
            target = lines[:, : target.shape[1]]
        if self.noise:
            strength = self.noise * torch.rand(len(spectra), 1, device=spectra.device) ** 3
            spectra = spectra + strength * torch.randn_like(spectra)
        return {**batch, "input": spectra, "target": target, "lines": lines}

    def fingerprint(self) -> Mapping[str, str]:
        return {
            "root": str(self.root or "generated"),
            "version": f"cest {GENERATOR_VERSION}.{FIT_VERSION}",
            "preset": self.preset,
            "band": str(self.band),
            "left_out": str(self.skipped),
            **{name: str(len(part)) for name, part in zip(Splits._fields, self._splits, strict=True)},  # type: ignore[arg-type]
            "sha256": self._digest,
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return curve(inputs.detach().cpu().double().numpy())


def _remarks(volume: Volume, offsets: Sequence[float]) -> tuple[str, ...]:
    """Return clauses that say which parts of a volume are left out or resampled."""
    remarks = []
    outside = math.prod(volume.shape) - len(volume.spectra) - volume.dropped
    if outside:
        remarks.append(f"left out: {count_of(outside, 'voxel')} outside the mask, or without a number")
    if volume.dropped:
        remarks.append(f"left out: {count_of(volume.dropped, 'voxel')} with a number that is not finite")
    if volume.unread:
        remarks.append(f"left out: arrays that are not read ({', '.join(volume.unread)})")
    if len(volume.offsets) != len(offsets) or not np.allclose(volume.offsets, offsets):
        remarks.append(f"resampled: from the file's {len(volume.offsets)} offsets to {len(offsets)}")
    return tuple(remarks)


def _digest(*tensors: Tensor) -> str:
    """Return the SHA-256 of the tensors' values."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(np.ascontiguousarray(tensor.numpy()).tobytes())
    return digest.hexdigest()
