"""mode=test: test a trained model again, on its own data or on other data."""

from framework.configuration.config import Config, Options
from framework.reports.report import report_test
from framework.runs.run import open_run
from framework.runs.session import add_test_parts, for_trained


def run(config: Config) -> None:
    """Test the model of `checkpoint`, and print its table row."""
    config.options(Options)
    session = add_test_parts(for_trained(config))
    with open_run(session.config) as run:
        session.record(run)
        report_test(run, session)
