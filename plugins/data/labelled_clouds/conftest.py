"""Fixtures that build the data set which a test's module names, in a cache of the test's own."""

import pytest

from framework.configuration.schema import build, resolve


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path_factory.mktemp("cache")))


@pytest.fixture
def data(request):
    def make(**config):
        if "root" in config:
            config["root"] = str(config["root"])
        return build("data", resolve("data", {"name": request.module.NAME, **config}))

    return make


@pytest.fixture
def prepared(data):
    def make(**config):
        found = data(**config)
        found.prepare()
        return found

    return make
