"""Settings of the core: types, ranges and defaults; the settings of plugins are checked by their constructors."""

import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from framework.configuration.schema import check, forbid_targets
from framework.errors import ConfigError, did_you_mean, shorten
from framework.tracking.stores import require_no_password

if TYPE_CHECKING:
    import torch


def _share(value: Any) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not (value >= 1 if isinstance(value, int) else 0 < value <= 1):
        raise ValueError(
            "expected a number of batches (an integer, 1 or more), or a share of them (0.0 < share <= 1.0)"
        )
    return value


def _rate(value: Any) -> Any:
    if value == "auto":
        return value
    try:
        number = TypeAdapter(float).validate_python(value)
    except ValidationError:
        number = math.nan
    if not 0 < number < math.inf:
        raise ValueError("expected a number greater than 0, or auto")
    return number


def _devices(value: Any) -> Any:
    listed = value if isinstance(value, list) else [value]
    numbers = [
        int(item) for item in listed if not isinstance(item, bool) and re.fullmatch(r"-?\d+", str(item))
    ]
    if value in (None, "auto", -1) or (listed is value and numbers == value and min(value, default=-1) >= 0):
        return value
    if listed is not value and (numbers > [0] or re.fullmatch(r"\d+(,\d+)+", str(value))):
        return value
    raise ValueError("expected a number of devices (1 or more), a list of device indices, or auto")


MOST_AT_ONCE = 1024
"""Largest number of threads, and of data-loading processes, of one run."""
Positive = Annotated[int, Field(gt=0)]
NotNegative = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
Flag = Annotated[bool, Field(strict=True)]
Share = Annotated[Any, AfterValidator(_share)]
STRATEGIES = (
    *("auto", "single_device", "ddp"),
    *("ddp_find_unused_parameters_true", "ddp_find_unused_parameters_false"),
)
"""Names of the strategies of Lightning with which a training works.

Lightning has others: with ddp_fork and ddp_notebook the trained weights stay in the processes that trained them, and
the run continues with the initial ones; ddp_spawn cannot copy the run to the other processes; and the framework has no
checkpoints of models that are divided among devices (docs/processes.md).
"""
PRECISIONS = (
    *("32-true", "bf16-mixed", "16-mixed", "64-true", "bf16-true", "16-true", "transformer-engine"),
    *("transformer-engine-float16", "32", "16", "64", "bf16", 32, 16, 64),
)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", protected_namespaces=())


class OptimizerSettings(_Strict):
    """Optimiser of torch.optim, by its name in lower case, and schedule of its learning rate."""

    name: Literal["adam", "adamw", "sgd", "nadam", "radam"] = "adamw"
    learning_rate: Annotated[float | Literal["auto"], BeforeValidator(_rate)] = 1e-3
    """Learning rate, above 0; auto: the rate at which the loss falls fastest in a range test before the training."""
    momentum: Annotated[float, Field(ge=0, lt=1)] | None = None
    """Momentum of `sgd`; None means 0. The other optimisers have fixed kinds of momentum and refuse this setting."""
    weight_decay: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    schedule: Literal["constant", "cosine", "step", "plateau"] = "constant"
    warmup_steps: NotNegative = 0
    """Number of steps in which the learning rate rises linearly, at most a quarter of the training's steps."""
    factor: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Factor by which the schedules `step` and `plateau` multiply the learning rate to reduce it."""
    milestones: list[Count] = []
    """Epochs after which the schedule `step` reduces the learning rate."""
    patience: Count = 5
    """Number of epochs without a lower validation loss after which the schedule `plateau` reduces the learning rate."""

    @property
    def rate(self) -> float:
        """Return the learning rate.

        Raises:
            ConfigError: The rate is "auto" and has not been replaced by a number.
        """
        if isinstance(self.learning_rate, str):
            raise ConfigError(
                "optimizer.learning_rate = 'auto' applies only to models that are trained by gradient descent in this "
                "command. Set it to a number."
            )
        return self.learning_rate

    @model_validator(mode="after")
    def _fits(self) -> "OptimizerSettings":
        if self.momentum is not None and self.name != "sgd":
            raise ValueError(
                f"momentum is a setting of sgd only, and the optimiser is {self.name}. Leave momentum out, or choose "
                "sgd"
            )
        if self.schedule == "step" and not self.milestones:
            raise ValueError(
                "schedule=step reduces the learning rate after the epochs in milestones, but milestones is empty. Set "
                "milestones, such as [2000]"
            )
        if self.milestones and self.schedule != "step":
            raise ValueError(
                f"milestones are a setting of schedule=step only, and the schedule is {self.schedule}. Leave "
                "milestones out, or choose step"
            )
        return self


class LoggerSettings(_Strict):
    """Destination of metrics in addition to the local journal."""

    name: Literal["mlflow", "none"] = "mlflow"
    uri: str | None = None
    """Address of the store, without a password.

    None means the environment variable MLFLOW_TRACKING_URI or, if it is not set, mlflow.db in the outputs folder.
    """
    experiment: str | None = None
    copies: list[Literal["csv", "tensorboard", "wandb"]] = []
    """Further formats in which the numbers of a run are written to files on this machine."""


class BudgetSettings(_Strict):
    """Limit of the run time or of the error of a stored model, which decides how its knobs are set."""

    milliseconds: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    """Largest run time per sample, ms; the model gets the best setting of its knobs within it."""
    error: Annotated[float, Field(allow_inf_nan=False)] | None = None
    """Largest error on the validation split, in the unit of `metric`; the model gets the fastest setting within it."""
    metric: str | None = None
    """Name of the error among the numbers that the model's metrics compute, such as `maad_deg`.

    null chooses the first number that is better if it is lower or, without such a number, the first number. If the
    chosen number is better if it is higher, `error` is its smallest allowed value.
    """
    batch_size: Positive | None = None
    """Number of samples of the batch whose run time is measured.

    null means 64 for mode=predict, which predicts 64 samples at once, and 1 for mode=export and `framework.load`.
    """

    @model_validator(mode="after")
    def _one_limit(self) -> "BudgetSettings":
        if self.milliseconds is not None and self.error is not None:
            raise ValueError(
                "milliseconds and error are both set, but a budget limits one of them. Leave one of them out"
            )
        unused = [key for key in ("metric", "batch_size") if getattr(self, key) is not None]
        if unused and not self.limits:
            raise ValueError(
                f"{unused[0]} has no effect without a limit. Set milliseconds or error, or leave {unused[0]} out"
            )
        return self

    @property
    def limits(self) -> bool:
        """Return whether the run time or the error is limited."""
        return self.milliseconds is not None or self.error is not None


REFUSED_CALLBACKS = {
    "lr_monitor": "the learning rate is always recorded, as train/learning_rate in the journal",
    "learning_rate_monitor": "the learning rate is always recorded, as train/learning_rate in the journal",
    "lr_finder": "set optimizer.learning_rate=auto instead",
    "learning_rate_finder": "set optimizer.learning_rate=auto instead",
    "swa": "choose weight_averaging with decay=null, or the wrapper uncertainty=[swag]",
    "stochastic_weight_averaging": "choose weight_averaging with decay=null, or the wrapper uncertainty=[swag]",
    "ema": "choose weight_averaging",
    "timer": "set trainer.max_time instead",
    "model_checkpoint": "checkpoints are always written; set trainer.keep and trainer.checkpoint_every_steps",
    "on_exception_checkpoint": "a run that fails keeps its checkpoints; resume=<folder of the run> continues it",
    "progress_bar": "set trainer.enable_progress_bar instead",
    "rich_progress_bar": "set trainer.enable_progress_bar instead",
    "tqdm_progress_bar": "set trainer.enable_progress_bar instead",
    "rich_model_summary": "choose model_summary",
    "device_stats_monitor": "set trainer.profiler=simple instead",
    "throughput_monitor": "set trainer.profiler=simple instead",
    "batch_size_finder": "set batch_size to a number, because results depend on it",
    "gradient_accumulation_scheduler": "choose gradient_accumulation",
    "lambda_callback": "a config holds no code",
    "model_pruning": "a resumed run would not continue with the same bits",
    "backbone_finetuning": "a resumed run would not continue with the same bits; encoders have settings to freeze them",
    "prediction_writer": "mode=predict writes predictions",
}
"""Callbacks of Lightning that cannot be chosen, each with the reason or what to do instead."""


class EarlyStoppingSettings(_Strict):
    """Conditions under which a training stops early, in addition to `trainer.patience`."""

    min_delta: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Smallest fall of the validation loss that counts, nats."""
    stopping_threshold: Annotated[float, Field(allow_inf_nan=False)] | None = None
    """Validation loss below which the training stops, nats."""


class WeightAveragingSettings(_Strict):
    """Average of the weights over the steps of a training."""

    decay: Annotated[float, Field(gt=0, lt=1)] | None = 0.999
    """Share of the old average that a step keeps; null: the mean of all steps with equal weights."""
    first_epoch: NotNegative = 0
    """Epoch, from 0, at which the average begins."""


class GradientAccumulationSettings(_Strict):
    """Numbers of batches whose gradients are averaged for one optimiser step, by epoch."""

    batches: Annotated[dict[NotNegative, Count], Field(min_length=1)]
    """Number of batches of an optimiser step from an epoch on, by this epoch, counted from 0.

    Before the first of these epochs a step has one batch.
    """


class ModelSummarySettings(_Strict):
    """Table of the parts of the model that is printed before the training."""

    max_depth: Annotated[int, Field(strict=True, ge=-1)] = 1
    """Depth of the parts that are listed; -1 lists all."""


CALLBACKS: Mapping[str, type[BaseModel]] = {
    "early_stopping": EarlyStoppingSettings,
    "weight_averaging": WeightAveragingSettings,
    "gradient_accumulation": GradientAccumulationSettings,
    "model_summary": ModelSummarySettings,
}
"""Settings of the callbacks that a config may choose, by the names of the callbacks."""


class CallbackSettings(_Strict):
    """Chosen callbacks of Lightning for a training, with their settings; None for a callback that is not chosen."""

    early_stopping: EarlyStoppingSettings | None = None
    weight_averaging: WeightAveragingSettings | None = None
    gradient_accumulation: GradientAccumulationSettings | None = None
    model_summary: ModelSummarySettings | None = None

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, value: Any) -> Any:
        names = list(value) if isinstance(value, list | tuple | dict) else []
        for name in names:
            refuse_callback(name)
        return {name: {} for name in names} if isinstance(value, list | tuple) else value


def refuse_callback(name: Any) -> None:
    """Raise an error if Lightning's callback of this name cannot be chosen, or if there is no such callback.

    Raises:
        ValueError: The message says what to do instead, or names the nearest callback.
    """
    if name in CallbackSettings.model_fields:
        return
    known = ", ".join(CallbackSettings.model_fields)
    if name in REFUSED_CALLBACKS:
        raise ValueError(f"the callback {name} cannot be chosen: {REFUSED_CALLBACKS[name]}")
    near = did_you_mean(str(name), CallbackSettings.model_fields)
    raise ValueError(f"there is no callback {shorten(str(name))!r}.{near} The callbacks are {known}")


class TrainerSettings(_Strict):
    """Keys of `trainer`: the framework's own, and the arguments of pytorch_lightning.Trainer that a config can hold.

    The class is used only to check the keys; keys that are not given have Lightning's defaults. The arguments are
    listed here because importing Lightning takes seconds.
    """

    callbacks: CallbackSettings | None = None
    """Callbacks of Lightning by name, such as `[weight_averaging]`, with their settings."""
    patience: Count | None = None
    keep: Literal["best", "last"] | None = None
    checkpoint_every_steps: Count | None = None
    log_every_steps: Count | None = None
    max_epochs: Count | None = None
    min_epochs: Count | None = None
    max_steps: Annotated[int, Field(strict=True, ge=-1)] | None = None
    min_steps: Count | None = None
    max_time: Annotated[str, Field(pattern=r"^\d+:\d{2}:\d{2}:\d{2}$")] | None = None
    """Longest duration of a training as days, hours, minutes and seconds, dd:hh:mm:ss."""
    check_val_every_n_epoch: Count | None = None
    val_check_interval: Share | None = None
    limit_train_batches: Share | None = None
    limit_val_batches: Share | None = None
    limit_test_batches: Share | None = None
    limit_predict_batches: Share | None = None
    overfit_batches: Share | None = None
    accumulate_grad_batches: Count | None = None
    gradient_clip_val: Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)] | None = None
    gradient_clip_algorithm: Literal["norm", "value"] | None = None
    accelerator: Literal["auto", "cpu", "gpu", "cuda", "mps", "tpu"] | None = None
    strategy: Literal[STRATEGIES] | None = None  # pyright: ignore[reportInvalidTypeForm]
    precision: Literal["auto", *PRECISIONS] | None = None  # pyright: ignore[reportInvalidTypeForm]
    """Number format; auto: bf16-mixed on a processor that multiplies bfloat16 numbers fast, else 32-true."""
    devices: Annotated[Any, AfterValidator(_devices)] = None
    num_nodes: Count | None = None
    num_sanity_val_steps: Annotated[int, Field(strict=True, ge=-1)] | None = None
    log_every_n_steps: Count | None = None
    reload_dataloaders_every_n_epochs: NotNegative | None = None
    deterministic: Literal[True, False, "warn"] | None = None
    benchmark: Flag | None = None
    fast_dev_run: Flag | None = None
    enable_progress_bar: Flag | None = None
    enable_model_summary: Flag | None = None
    inference_mode: Flag | None = None
    detect_anomaly: Flag | None = None
    barebones: Flag | None = None
    sync_batchnorm: Flag | None = None
    enable_autolog_hparams: Flag | None = None
    profiler: Literal["simple", "advanced", "pytorch", "xla"] | None = None
    """Profiler of Lightning; its report on the training is `fit-profile.txt` in the run folder."""
    model_registry: str | None = None


TRAINER_OURS = {"callbacks", "patience", "checkpoint_every_steps", "log_every_steps", "keep"}
"""Keys of `trainer` that the framework reads; the others go to pytorch_lightning.Trainer."""


class Settings(_Strict):
    """Composed config of a command: the settings of the core, checked, and the chosen plugins.

    The constructors of the plugins check their parameters (`framework.configuration.assembly`), so that the config of a
    plugin is any value here. A group from which several plugins may be chosen has a mapping from names to plugins.
    """

    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    threads: Annotated[int, Field(gt=0, le=MOST_AT_ONCE)] | None = None
    batch_size: Positive = 64
    workers: Annotated[int, Field(ge=0, le=MOST_AT_ONCE)] = 0
    samples: Positive = 1000
    pictures: Literal[True, False, "png", "pdf", "svg"] = True
    """Format of the figures; True means png, and False means that no figures are drawn."""
    checkpoint: str | None = None
    resume: str | None = "auto"
    stored: dict[str, Any] = {}
    """Values by group that replace those of a checkpoint's config; `data.root=...` beside `checkpoint=...` sets one."""
    experiment_name: str | None = None
    optimizer: OptimizerSettings = OptimizerSettings()
    logger: LoggerSettings = LoggerSettings()
    trainer: dict[str, Any] = {}
    budget: BudgetSettings = BudgetSettings()
    mode: dict[str, Any] = {}
    data: Any = None
    outliers: Any = None
    encoder: Any = None
    density_head: Any = None
    uncertainty: Any = None
    objective: Any = None
    metric: Any = None
    renderer: Any = None

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "Settings":
        """Return the checked settings of a composed config.

        Raises:
            ConfigError: The config contains `_target_`, a key is unknown, or a value is out of range.
        """
        forbid_targets(config)
        for key, model in (
            ("optimizer", OptimizerSettings),
            ("logger", LoggerSettings),
            ("budget", BudgetSettings),
        ):
            if isinstance(config.get(key), Mapping):
                check(model, config[key], key)
        check(cls, config, "")
        settings = cls.model_validate(dict(config))
        if settings.logger.uri is not None:
            require_no_password(settings.logger.uri)
        callbacks = settings.trainer.get("callbacks")
        for name, values in callbacks.items() if isinstance(callbacks, Mapping) else ():
            if name in CALLBACKS and isinstance(values, Mapping):
                check(CALLBACKS[name], values, f"trainer.callbacks.{name}")
        check(TrainerSettings, settings.trainer, "trainer")
        return settings

    def plain(self) -> dict[str, Any]:
        """Return the settings that the composed config contains, as the plain values that the run folder stores."""
        return self.model_dump(exclude_unset=True)

    @property
    def callbacks(self) -> CallbackSettings:
        """Return the callbacks of the training and their settings."""
        return CallbackSettings.model_validate(self.trainer.get("callbacks") or {})

    @property
    def is_short_test(self) -> bool:
        """Return whether the run trains on at most ten batches, as with `debug=fast`, which only tries all stages."""
        batches, epochs = self.trainer.get("limit_train_batches"), self.trainer.get("max_epochs")
        return isinstance(batches, int) and isinstance(epochs, int) and batches * epochs <= 10

    @property
    def bounded_trainer(self) -> dict[str, Any]:
        """Return `trainer` with a validation interval of at most `max_epochs`, so that a short run is validated too."""
        every, epochs = self.trainer.get("check_val_every_n_epoch"), self.trainer.get("max_epochs")
        return self.trainer | ({"check_val_every_n_epoch": min(every, epochs)} if every and epochs else {})


def store_experiment(config: Mapping[str, Any], trained_on: str = "") -> str:
    """Return the name of the experiment to which a run belongs in the tracking store.

    The name is the first of these that exists:
    - `logger.experiment`;
    - the part of `experiment=` before the slash, such as "moons" for `experiment=moons/scvae`;
    - the name of the data set;
    - `trained_on`, the data set on which the stored model was trained;
    - "Default", the experiment that MLflow creates itself.

    All methods on the same data share one experiment, so that the runs of a sweep over methods appear under their
    parent and can be compared.

    Args:
        config: Composed config of the run.
        trained_on: Name of the data set on which the stored model of the command was trained; "" without such a model.
    """
    logger = config.get("logger") or {}
    name = config.get("experiment_name")
    data = config.get("data")
    chosen = data.get("name") if isinstance(data, Mapping) else data
    return str(
        logger.get("experiment") or (name.partition("/")[0] if name else chosen) or trained_on or "Default"
    )


def device_of(accelerator: str | None) -> "torch.device":
    """Return the device on which a stored model is tested: a GPU if there is one, unless the user chose another device.

    Args:
        accelerator: Value of `trainer.accelerator`; None and "auto" use CUDA if the machine has it, else the CPU.

    Raises:
        ConfigError: This machine does not have the device, or the device can only train.
    """
    import torch

    require_device(accelerator)
    if accelerator == "tpu":
        raise ConfigError(
            "trainer.accelerator = 'tpu': a TPU can only train, not test a stored model. Choose auto, cpu, gpu, cuda "
            "or mps."
        )
    if accelerator in (None, "auto", "gpu"):
        accelerator = "cuda" if torch.cuda.is_available() else "mps" if accelerator == "gpu" else "cpu"
    return torch.device(accelerator)


def require_device(accelerator: str | None) -> None:
    """Refuse a device that this machine does not have.

    Raises:
        ConfigError: PyTorch finds no such device.
    """
    if accelerator in ("gpu", "cuda", "mps"):
        import torch

        available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
        if not (any(available.values()) if accelerator == "gpu" else available[accelerator]):
            raise ConfigError(
                f"trainer.accelerator = {accelerator!r}: PyTorch finds no such device on this machine. Choose auto or "
                "cpu, or install the PyTorch that fits your driver."
            )
