"""A study's cases on a Dask cluster: on workers with the same code only, and a lost scheduler is told as what it is."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Any

from grindvision.errors import InputError

if TYPE_CHECKING:
    from distributed import Future

#: Cases handed to the cluster at a time: enough for a thousand cores, few enough for its scheduler's memory.
IN_FLIGHT = 2000

Row = dict[str, Any]


def on_cluster(
    measured: Callable[..., Row],
    measure: Callable[..., Mapping[str, Any]],
    missing: Mapping[int, Mapping[str, Any]],
    seed: int,
    scheduler: str,
) -> Generator[Row, None, None]:
    """Yield ``measured(measure, case, parameters, seed)`` of every missing case, as the rows come.

    Raises:
        InputError: no scheduler answers, or it is lost; a worker has other code, whenever it joined.
    """
    from distributed import Client, as_completed

    try:
        client = Client(scheduler, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at {scheduler} ({error}); start one with `dask scheduler`"
        ) from None
    module = measure.__module__
    code = _fingerprint(module)
    with client:
        for worker, other in client.run(_fingerprint, module, on_error="return").items():
            _check(worker, other, code)
        tasks = (
            client.submit(_task, measured, measure, case, dict(values), seed, pure=False)
            for case, values in missing.items()
        )
        running = as_completed(islice(tasks, IN_FLIGHT), loop=client.loop, with_results=True, raise_errors=False)
        for future, answer in running:
            yield _row(future, answer, code, scheduler)
            try:
                running.update(islice(tasks, 1))
            except (OSError, RuntimeError):
                raise _lost(scheduler) from None


def _task(
    measured: Callable[..., Row], measure: Callable[..., Mapping[str, Any]], case: int, values: Row, seed: int
) -> tuple[str, str, Row]:
    """Runs on a worker: its address, the state of its code, and the row."""
    from distributed import get_worker

    return get_worker().address, _fingerprint(measure.__module__), measured(measure, case, values, seed)


def _row(future: Future, answer: Any, code: str, scheduler: str) -> Row:
    if future.status == "finished" and isinstance(answer, tuple):
        worker, other, row = answer
        _check(worker, other, code)
        return row
    if future.status == "error":
        error = answer[1]
        if isinstance(error, (ImportError, AttributeError)):
            raise InputError(
                f"a worker has other grindvision code, which cannot run this study ({error}); install the same there"
            ) from None
        raise error
    raise _lost(scheduler)


def _lost(scheduler: str) -> InputError:
    return InputError(
        f"the Dask scheduler at {scheduler} was lost; finished rows are in the results file: start it again and repeat "
        "the command"
    )


def _check(worker: str, other: object, code: str) -> None:
    if other != code:
        shown = other if isinstance(other, str) else f"other code ({type(other).__name__}: {other})"
        raise InputError(f"worker {worker} has grindvision code {shown}, here it is {code}; install the same there")


def _fingerprint(module: str) -> str:
    from grindvision_book.studies.running import code_fingerprint

    return code_fingerprint(module)
