"""mode=test: test a trained model again, on its own data or on other data."""

from framework.configuration.config import Config, Options
from framework.reports.report import report_test
from framework.runs.run import opened
from framework.runs.session import for_trained, tested


def run(config: Config) -> None:
    """Test the model of `checkpoint`, and print its table row."""
    config.options(Options)
    session = tested(for_trained(config))
    with opened(session.config) as run:
        session.record(run)
        report_test(run, session)
