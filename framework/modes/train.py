"""mode=train: fit a model, calibrate it, test it and report the results."""

from framework.configuration.config import Config, Options
from framework.reports.report import report_test, report_training
from framework.runs.fit import fit
from framework.runs.job import write_value
from framework.runs.resuming import remove_resume_files
from framework.runs.run import open_run
from framework.runs.session import calibrate, for_training
from framework.storage.first_rank import first_rank


def run(config: Config) -> float:
    """Train and test a model; return the validation loss (nats) of the tested weights, which a sweeper minimises.

    A run that a search ends early (`framework.training.module.StopIfPruned`) is not tested, and has no value for the
    sweeper.
    """
    config.options(Options)
    session = for_training(config)
    with open_run(config) as run:
        session.console.print(f"run folder: {run.folder}", soft_wrap=True, highlight=False)
        session.record(run)
        loss, epoch, pruned = fit(session, run)
        if not first_rank():
            return loss
        if pruned:
            session.console.print("The search ended this training, and the model is not tested.")
            run.tracker.set_tags({"pruned": "true"})
            remove_resume_files(run)
            return loss
        if epoch is not None:
            report_training(run, session, kept_epoch=epoch)
        calibrate(session)
        session.save_model(run)
        report_test(run, session)
        remove_resume_files(run)
    write_value(config.folder, loss)
    return loss
