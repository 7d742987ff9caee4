"""What drivers share lives as long as their bench."""

import numpy as np
import pytest

from drivers.context import BenchContext
from protocols.bench import BenchFile
from protocols.preparation import Preparation

CLOSED = []


class Shared:
    def __init__(self, context):
        self.context = context

    def close(self):
        CLOSED.append(type(self).__name__)


class Inner(Shared):
    pass


class Outer(Shared):
    def __init__(self, context):
        super().__init__(context)
        context.share(Inner)


class Refusing(Shared):
    def close(self):
        super().close()
        raise RuntimeError("does not close")


class Plain:
    def __init__(self, context):
        pass


@pytest.fixture
def context():
    del CLOSED[:]
    preparation = Preparation("R07", "A", "asymmetric")
    return BenchContext(BenchFile.from_file(), preparation, np.random.default_rng(1), print)


def test_a_shared_object_is_made_once(context):
    assert context.share(Outer) is context.share(Outer)
    assert CLOSED == []


def test_closing_closes_what_is_shared_once_the_last_made_first(context):
    for make in (Outer, Refusing, Plain):
        context.share(make)
    context.close()
    assert CLOSED == ["Refusing", "Outer", "Inner"]
    context.close()
    assert len(CLOSED) == 3
