"""Fixtures that build the data set whose name is in the test's module, and give each test its own cache."""

import pytest

from framework.configuration.schema import build, resolve


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Give each test a cache of its own."""
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path_factory.mktemp("cache")))


@pytest.fixture
def data(request):
    """Return a function that builds the data set whose name is NAME in the test's module."""

    def make(**config):
        if "root" in config:
            config["root"] = str(config["root"])
        return build("data", resolve("data", {"name": request.module.NAME, **config}))

    return make


@pytest.fixture
def prepare_data(data):
    """Return a function that builds and prepares the data set."""

    def make(**config):
        dataset = data(**config)
        dataset.prepare()
        return dataset

    return make
