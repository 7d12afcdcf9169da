"""mode=export: write a trained model as a folder that runs with NumPy and ONNX Runtime alone."""

import shlex
from pathlib import Path

from framework.configuration.config import Config, Options
from framework.configuration.loading import load_with_description
from framework.configuration.paths import flatten
from framework.deployment.export import export, require_packages
from framework.deployment.loaded import apply_budget
from framework.errors import ConfigError, significant
from framework.runs.session import set_up_process
from framework.storage.enclosed import require_enclosed


class ExportOptions(Options):
    """Options of mode=export: the folder to write; by default `exported` in the run folder of the command."""

    into: str | None = None


def run(config: Config) -> None:
    """Write the exported model, and print its largest difference from the original and the time of its predictions."""
    options = config.options(ExportOptions)
    console = set_up_process(config.settings)
    require_packages()
    checkpoint = config.settings.checkpoint
    if checkpoint is None:
        raise ConfigError("mode=export needs checkpoint=<run folder, checkpoint file or MLflow run id>.")
    into = Path(options.into).expanduser() if options.into else config.folder / "exported"
    require_enclosed(into, ConfigError)
    predictor, description = load_with_description(
        checkpoint, uri=config.settings.logger.uri, paths=flatten(config.settings.stored)
    )
    if config.settings.budget.limits:
        description = apply_budget(
            predictor, description, config.settings.budget, paths=flatten(config.settings.stored)
        )
    content = export(predictor, description, into)
    parity = {name: numbers["parameters"] for name, numbers in content["parity"].items()}
    console.print(f"exported to {into}", soft_wrap=True)
    console.print(
        "largest difference from the model, as a share of the largest parameter: "
        + ", ".join(f"{number:.1e} for {name} inputs" for name, number in parity.items()),
        soft_wrap=True,
    )
    for count, times in content["milliseconds"].items():
        forms = ", ".join(f"{name} {significant(time, 3)}" for name, time in times.items())
        console.print(f"processor milliseconds of a batch of {count}: {forms}", soft_wrap=True)
    for remark in description.remarks:
        console.print(remark, soft_wrap=True)
    programs = (shlex.join(["python", str(into / name), "--help"]) for name in ("predict.py", "serve.py"))
    console.print("next commands: " + "\n               ".join(programs), soft_wrap=True, highlight=False)
