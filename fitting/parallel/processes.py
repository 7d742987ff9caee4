"""Apply a function to several items in parallel, each in a separate (forked) process.

Every process starts with a copy of this process's memory and changes nothing for the others. The
results therefore depend neither on the order of the items nor on the number of processors.
"""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")

# Other platforms cannot fork, or not safely.
_SPLITS = sys.platform == "linux"
# Limit of processes, because each needs its own memory.
_MOST = 8


def map_processes(work: Callable[[Item], Made], items: Sequence[Item]) -> Generator[Made]:
    """Call a function for every item in parallel processes; yield results in the order of items.

    There are as many processes as processors, at most 8. If a process dies or cannot be started,
    its item is computed in this process; so are all items where forking is not possible, or inside
    such a process.

    Parameters
    ----------
    work : callable
        Its results and exceptions must be picklable. Changes that it makes in memory are lost.
    items : sequence

    Raises
    ------
    Exception
        The exceptions of `work`.
    """
    if not _SPLITS or multiprocessing.current_process().daemon or len(items) < 2:
        yield from map(work, items)
        return
    most = min(len(os.sched_getaffinity(0)), _MOST)
    waiting = deque(range(len(items)))
    running: dict[Connection, tuple[int, BaseProcess]] = {}
    ended: dict[int, Future[Made]] = {}
    try:
        for number in range(len(items)):
            while number not in ended:
                while waiting and len(running) < most:
                    begun = waiting.popleft()
                    try:
                        connection, process = _split_off(work, items[begun], running)
                    except OSError:
                        ended[begun] = _done(work, items[begun])
                    else:
                        running[connection] = begun, process
                for connection in _answering(running):
                    done, process = running[connection]
                    ended[done] = _handed_back(connection, process) or _done(work, items[done])
                    del running[connection]
            yield ended.pop(number).result()
    finally:
        for connection, (_, process) in running.items():
            _end(connection, process)


def _answering(running: dict[Connection, tuple[int, BaseProcess]]) -> list[Connection]:
    """Wait for one or more; none if none is running."""
    found = wait(list(running)) if running else []
    return [connection for connection in found if isinstance(connection, Connection)]


def _split_off(
    work: Callable[[Item], Made], item: Item, others: Iterable[Connection]
) -> tuple[Connection, BaseProcess]:
    """Begin a piece of work: where its answer comes from, and its process.

    Raises
    ------
    OSError
        If there may not be another process.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(
        target=_answer, args=(there, [here, *others], work, item), daemon=True
    )
    # Until a process minds no interrupt itself, see `_answer`.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with warnings.catch_warnings():
            # Other threads only show progress, or wait for numbers: nothing that is needed there.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError:
        here.close()
        raise
    finally:
        there.close()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return here, process


def _answer(
    there: Connection, inherited: list[Connection], work: Callable[[Item], Made], item: Item
) -> None:
    """Compute one item in the child process and send the result back."""
    # An interrupt goes to all processes: the parent ends its children.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    # Only the parent reads, so that no result waits for a process that has died.
    for connection in inherited:
        connection.close()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # The copy of a progress display may hold the locks of standard output.
    with open(os.dup(2), "w", encoding="utf-8") as said:
        sys.stdout = sys.stderr = said
        answer = _packed(_done(work, item))
        # Once it has the answer, the parent may end this process.
        said.flush()
        there.send_bytes(answer)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _packed(done: Future[Made]) -> bytes:
    """Pickle a result or exception."""
    trouble = done.exception()
    try:
        packed = pickle.dumps((trouble, None if trouble else done.result()))
        if trouble:
            pickle.loads(packed)
    except Exception as error:  # noqa: BLE001  # objects that cannot be pickled may raise anything
        words = repr(trouble) if trouble else f"what was made cannot be handed back: {error}"
        packed = pickle.dumps((RuntimeError(words), None))
    return packed


def _handed_back(connection: Connection, process: BaseProcess) -> Future[Made] | None:
    """Return the result or exception of a process; None if it has died."""
    try:
        trouble, made = pickle.loads(connection.recv_bytes())
    except (EOFError, OSError):
        return None
    finally:
        _end(connection, process)
    done: Future[Made] = Future()
    if trouble is None:
        done.set_result(made)
    else:
        done.set_exception(trouble)
    return done


def _end(connection: Connection, process: BaseProcess) -> None:
    connection.close()
    process.terminate()
    process.join()


def _done(work: Callable[[Item], Made], item: Item) -> Future[Made]:
    done: Future[Made] = Future()
    try:
        done.set_result(work(item))
    except Exception as trouble:  # noqa: BLE001  # raised where the answer is asked for
        done.set_exception(trouble)
    return done
