"""Data set of flights of a table-tennis ball; framework.data describes the contract."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath
from framework.data import Batch, Data, Splits
from framework.datasets.csv_columns import Writing
from framework.datasets.fields import Fields
from framework.errors import DataError, count_of, shorten
from framework.flights.frames import PARTS
from framework.flights.physics import Constants
from framework.geometry.meshes import stream
from framework.storage.arrays import to_real
from framework.storage.generated import read_mark
from framework.target import Target
from plugins.data.table_tennis.picture import side_view
from plugins.data.table_tennis.recordings import (
    SUFFIXES,
    Flight,
    LengthsIn,
    TimesIn,
    count_missing_frames,
    drop_repeated,
    flights_of,
    list_files,
    unread_columns,
)
from plugins.data.table_tennis.simulator import Simulation, ensure_simulated
from plugins.data.table_tennis.windows import Grid, Window, prefix, windows

Share = Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)]


class TableTennis(Data):
    """Future positions of a ball, predicted from its observed positions (thesis §4.2); simulated if no root is given.

    An input is the flattened array of the last `observed` frames, with five numbers for each frame: time, x, y, z, and
    whether the ball was seen (`PARTS`). The target is the recorded positions at the next `future` multiples of the
    step, metres. Batches also hold "flight", the number of the flight, and "truth", with the shape of the target: the
    positions without noise if the flight was simulated, otherwise the target itself.

    All windows of a flight are in one split; a flight that is recorded twice counts once.

    Args:
        root: A folder of flights, or one file: *.csv with the columns t (s), x, y, z (m), or *.mat of the WAM
            laboratory. None for simulated flights.
        grid: Settings of the frames that are read and predicted.
        validation: Share of the flights for validation, chosen at random.
        test: Share of the flights for the test, chosen at random.
        data_seed: Seed of the choice of these flights, independent of the seed of the run.
        forget: Share of the observed frames that are hidden at random from each training window.
        unreadable: Treatment of files that cannot be read. "error" refuses them, "skip" leaves them out.
        times_in: Unit of the times in the files.
        lengths_in: Unit of the positions in the files; targets and predictions are in metres.
        writing: Notation of the CSV files: separator, decimal sign and the like.
        simulation: Settings of the simulated flights.
        constants: Constants of the simulated ball and table.
    """

    bibtex = "gomez2020real"
    groups = ("table_tennis",)
    suffixes = SUFFIXES

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        *,
        root: FilePath | None = None,
        grid: Grid,
        validation: Share = 0.1,
        test: Share = 0.2,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
        forget: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.0,
        unreadable: Literal["error", "skip"] = "error",
        times_in: TimesIn = "seconds",
        lengths_in: LengthsIn = "metres",
        writing: Writing,
        simulation: Simulation,
        constants: Constants,
    ) -> None:
        self.root = root
        self.grid = grid
        self.shares = (validation, test)
        self.data_seed = data_seed
        self.forget = forget
        self.varies = forget > 0
        self.unreadable = unreadable
        self.times_in: TimesIn = times_in
        self.lengths_in: LengthsIn = lengths_in
        self.writing = writing
        self.simulation = simulation
        self.constants = constants
        self.input_shape = (self.grid.observed * len(PARTS),)

    def prepare(self) -> None:
        if self.root is None:
            root = ensure_simulated(self.simulation, self.constants, self.grid.step)
        else:
            root = Path(self.root).expanduser()
        recordings, left_out = self._read_flights(root)
        flights, self.repeated = drop_repeated(recordings)
        windows_of = [windows(flight, self.grid) for flight in flights]
        usable = [number for number, flight_windows in enumerate(windows_of) if flight_windows]
        self.short = len(flights) - len(usable)
        if len(usable) < 3:
            raise DataError(
                f"{root} has {len(flights)} flights, of which {len(usable)} have {self.grid.least} frames to read "
                f"and {self.grid.future} frames to predict without a gap; at least three such flights are required. "
                "Lower data.future or data.least, or give more flights."
            )
        self.lost = sum(count_missing_frames(flight, self.grid.step) for flight in flights)
        order = stream(self.data_seed, "splits").permutation(len(usable))
        sizes = [max(1, round(share * len(usable))) for share in self.shares]
        if sum(sizes) >= len(usable):
            raise DataError(
                f"data.validation + data.test = {sum(self.shares):g} leaves none of {len(usable)} flights for "
                "training. Lower these shares."
            )
        chosen = np.split(order, [len(usable) - sum(sizes), len(usable) - sizes[1]])
        self._tables = {
            name: _table(
                [(usable[n], window) for n in sorted(part.tolist()) for window in windows_of[usable[n]]]
            )
            for name, part in zip(Splits._fields, chosen, strict=True)
        }
        train = self._tables["train"].fields["target"].double()
        scale = train.std(0, unbiased=False).clamp(min=1e-3)
        self.target = Target("real", self.grid.names, tuple(train.mean(0).tolist()), tuple(scale.tolist()))
        self.synthetic = read_mark(root) is not None if root.is_dir() else False
        self.skipped = left_out
        unread = shorten(", ".join(self._unread_columns))
        remarks = (
            (unread, f"left out: the columns {unread}"),
            (self.repeated, f"left out: {count_of(self.repeated, 'repeated flight')}"),
            (
                self.short,
                f"left out: {count_of(self.short, 'flight')} too short to read {self.grid.least} frames and predict",
            ),
            (
                self.lost,
                f"missing, according to the times of the other frames: {count_of(self.lost, 'frame')}",
            ),
        )
        self.remarks = tuple(remark for applies, remark in remarks if applies)

    def check_files(self) -> None:
        if self.root is None:
            return
        first = list_files(Path(self.root).expanduser())[0]
        if self.unreadable == "error":
            self._required_flights(first)

    def _required_flights(self, file: Path) -> list[Flight]:
        """Return the flights of a file; if it cannot be read, name the setting that leaves it out.

        Raises:
            DataError: The file cannot be read.
        """
        try:
            return self._flights_of(file)
        except DataError as error:
            raise DataError(f"{error} Or set data.unreadable=skip to leave such files out.") from error

    def _read_flights(self, root: Path) -> tuple[list[Flight], int]:
        """Return the flights of all files, and the number of files that are left out.

        The names of the columns of the first file that are not read are stored in `_unread_columns`.
        """
        flights, left_out = [], 0
        unread: list[str] | None = None
        for file in list_files(root):
            try:
                flights += self._required_flights(file)
                unread = unread_columns(file, self.writing) if unread is None else unread
            except DataError:
                if self.unreadable == "error":
                    raise
                left_out += 1
        self._unread_columns = unread or []
        return flights, left_out

    def _flights_of(self, file: Path) -> list[Flight]:
        return flights_of(file, self.grid.step, self.times_in, self.writing, self.lengths_in)

    def splits(self) -> Splits:
        return Splits(**self._tables)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        """Return the input at the last frame of each flight, from which the next frames are predicted."""
        if not files:
            raise DataError(
                "No file was given. Give a flight as CSV with the columns t, x, y, z, or as *.mat."
            )
        flights = [flight for file in files for flight in self._flights_of(Path(file))]
        return Fields(
            input=torch.stack([self._last(flight) for flight in flights]), index=torch.arange(len(flights))
        )

    def _last(self, flight: Flight) -> Tensor:
        """Return the input at the last frame of a flight."""
        frames = prefix(flight, len(flight.times) - 1, self.grid)
        if frames is None:
            raise DataError(
                f"{flight.name} has fewer than {self.grid.least} frames in its last "
                f"{self.grid.observed * self.grid.step:g} s, which is too few to predict from. Give a longer recording."
            )
        return torch.from_numpy(frames).float()

    def inputs(self, user_data: Any) -> Tensor:
        """Return inputs from files, from one flight as an array (frame, 4) of t, x, y, z, or from ready inputs."""
        if isinstance(user_data, np.ndarray) and user_data.ndim == 2 and user_data.shape[1] == 4:
            try:
                table = to_real(user_data, "the given flight")
            except ValueError as error:
                raise DataError(f"{error}.") from error
            return self._last(Flight("the given flight", table[:, 0], table[:, 1:]))[None]
        return Data.inputs(self, user_data)

    def augment(self, batch: Batch) -> Batch:
        """Return the batch with frames hidden at random; the last frame stays visible."""
        if not self.forget:
            return batch
        inputs = batch["input"].unflatten(-1, (self.grid.observed, len(PARTS)))
        visible = torch.rand(inputs.shape[:2]).to(inputs.device) >= self.forget
        visible[:, -1] = True
        return {**batch, "input": (inputs * visible[..., None]).flatten(1)}

    def fingerprint(self) -> Mapping[str, str]:
        digest = hashlib.sha256()
        for table in self._tables.values():
            for name in ("input", "target"):
                digest.update(table.fields[name].numpy().tobytes())
        return {
            "root": str(self.root),
            "version": "table_tennis 1",
            **{name: str(len(table)) for name, table in self._tables.items()},
            "flights": " ".join(str(len(table.fields["flight"].unique())) for table in self._tables.values()),
            "repeated": str(self.repeated),
            "too short": str(self.short),
            "frames missing": str(self.lost),
            "sha256": digest.hexdigest(),
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return side_view(inputs.unflatten(-1, (self.grid.observed, len(PARTS))).detach().cpu().numpy())


def _table(samples: Sequence[tuple[int, Window]]) -> Fields:
    """Return the samples of a split from windows, each with the number of its flight."""
    inputs, target, truth = (
        torch.from_numpy(np.stack(part)).float()
        for part in list(zip(*(window for _, window in samples), strict=True))[:3]
    )
    return Fields(
        input=inputs,
        target=target,
        truth=truth,
        group=torch.zeros(len(samples), dtype=torch.int64),
        flight=torch.tensor([flight for flight, _ in samples]),
        index=torch.arange(len(samples)),
    )
