"""Work in pieces, side by side, each piece in a process of its own.

Every piece begins with what is known when it is split off: what one leaves in memory changes
nothing for another, so that results depend neither on their order nor on the number of processors.
"""

import multiprocessing
import os
import signal
import sys
import warnings
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")

# Elsewhere processes cannot be split off, or not safely.
_SPLITS = sys.platform == "linux"


def side_by_side(
    work: Callable[[Item], Made], items: Sequence[Item], at_once: int | None = None
) -> Generator[Made]:
    """Do work for every item; yield what it makes in the order of items.

    What a process has not handed back before it died is made again here. Where processes cannot be
    split off all is made here.

    Parameters
    ----------
    work : callable
        What it makes or raises must be possible to pickle; what it changes is lost.
    items : sequence
    at_once : int, optional
        Processes; as many as there are processors if not given.

    Raises
    ------
    Exception
        What work raises.
    """
    if not _SPLITS or multiprocessing.current_process().daemon or len(items) < 2:
        yield from map(work, items)
        return
    most = at_once or len(os.sched_getaffinity(0))
    waiting = deque(range(len(items)))
    running: dict[Connection, tuple[int, BaseProcess]] = {}
    ended: dict[int, Future[Made]] = {}
    try:
        for number in range(len(items)):
            while number not in ended:
                while waiting and len(running) < most:
                    begun = waiting.popleft()
                    connection, process = _split_off(work, items[begun])
                    running[connection] = begun, process
                for connection in _answering(running):
                    done, process = running.pop(connection)
                    ended[done] = _handed_back(connection, process) or _done(work, items[done])
            yield ended.pop(number).result()
    finally:
        for _, process in running.values():
            process.terminate()
            process.join()


def _answering(running: dict[Connection, tuple[int, BaseProcess]]) -> list[Connection]:
    return [found for found in wait(list(running)) if isinstance(found, Connection)]


def _split_off(work: Callable[[Item], Made], item: Item) -> tuple[Connection, BaseProcess]:
    """Begin a piece of work: where its answer comes from, and its process."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(there, work, item), daemon=True)
    with warnings.catch_warnings():
        # Other threads only show progress, or wait for numbers: the new process needs neither.
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()
    there.close()
    return here, process


def _answer(there: Connection, work: Callable[[Item], Made], item: Item) -> None:
    # Who interrupts means all: the process that is asked ends those that it has split off.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    done = _done(work, item)
    there.send((done.exception(), None if done.exception() else done.result()))


def _handed_back(connection: Connection, process: BaseProcess) -> Future[Made] | None:
    """What a process has made or raised; None if it has died."""
    with connection:
        try:
            trouble, made = connection.recv()
        except EOFError:
            return None
        finally:
            process.join()
    done: Future[Made] = Future()
    if trouble is None:
        done.set_result(made)
    else:
        done.set_exception(trouble)
    return done


def _done(work: Callable[[Item], Made], item: Item) -> Future[Made]:
    done: Future[Made] = Future()
    try:
        done.set_result(work(item))
    except Exception as trouble:  # noqa: BLE001 - raised where the answer is asked for
        done.set_exception(trouble)
    return done
