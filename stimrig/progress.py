"""`fit`, `carry`, `diagnose`, `improve` and `explain` of `identify`, with a progress bar in notebooks and terminals.

`progress` is True (a bar, if the work takes longer than a second), False (none), or a function of one's own that takes
a share of 0 to 1 and a line of text. All other parameters, results and errors are those of `identify`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from stimrig import identify
from stimrig.api.progress_bar import progress_bar

Callback = Callable[[float, str], None]
Progress = Callback | bool


def fit(
    record: identify.Record,
    method: str = "maximum-likelihood",
    effects: Sequence[str] = (),
    fit_on: Sequence[str] | None = None,
    progress: Progress = True,
    **options: Any,
) -> identify.Model:
    """Fit a model to a record: `method`, `effects=["fatigue"]`, `fit_on=["prbs"]`; see `stimrig.identify.fit`.

    Parameters
    ----------
    record : Record
        The measurement.
    method : str
        Id of the method.
    effects : sequence of str
        Ids of effects, as "fatigue" or "fatigue:fitness".
    fit_on : sequence of str, optional
        Segments that are fitted; default: all but `validate`.
    progress : bool or callable
        True: a bar, if it takes longer than a second; False: none; or called with a share of 0 to 1 and a
        line of text.
    **options
        Of the method.
    """
    with _telling(progress) as report:
        return identify.fit(record, method, effects, fit_on, report, **options)


def carry(record: identify.Record, model: identify.Model, progress: Progress = True) -> identify.Carried:
    """The structure of an earlier model fitted to a new record, beside the plain one; see `stimrig.identify.carry`.

    Parameters
    ----------
    record : Record
        The measurement.
    model : Model
        The earlier model.
    progress : bool or callable
        True: a bar, if it takes longer than a second; False: none; or called with a share of 0 to 1 and a
        line of text.
    """
    with _telling(progress) as report:
        return identify.carry(record, model, report)


def diagnose(
    record: identify.Record, model: identify.Model | None = None, progress: Progress = True
) -> identify.Diagnosis:
    """What is missing in the plain model of a record, or in a `model`; see `stimrig.identify.diagnose`.

    Parameters
    ----------
    record : Record
        The measurement.
    model : Model, optional
        Whose structure is asked about; default: the plain one.
    progress : bool or callable
        True: a bar, if it takes longer than a second; False: none; or called with a share of 0 to 1 and a
        line of text.
    """
    with _telling(progress) as report:
        return identify.diagnose(record, model, report)


def improve(
    record: identify.Record,
    progress: Progress = True,
    max_effects: int | None = None,
    force: Sequence[str] = (),
    model: identify.Model | None = None,
) -> identify.Improvement:
    """Add what is missing, one effect at a time, while the evidence asks for it; see `stimrig.identify.improve`.

    Parameters
    ----------
    record : Record
        The measurement.
    progress : bool or callable
        True: a bar, if it takes longer than a second; False: none; or called with a share of 0 to 1 and a
        line of text.
    max_effects : int, optional
        So many at most.
    force : sequence of str
        Ids of effects that are added whatever the evidence.
    model : Model, optional
        To begin with; default: the plain one.
    """
    with _telling(progress) as report:
        return identify.improve(record, report, max_effects, force, model)


def explain(
    record: identify.Record, model: identify.Model | None = None, progress: Progress = True
) -> identify.Explanation:
    """The whole story: where a model fails, what is missing, how the error falls with it, why that ends.

    Parameters
    ----------
    record : Record
        The measurement.
    model : Model, optional
        To begin with; default: the plain one.
    progress : bool or callable
        True: a bar, if it takes longer than a second; False: none; or called with a share of 0 to 1 and a
        line of text.
    """
    with _telling(progress) as report:
        return identify.explain(record, report, model)


@contextmanager
def _telling(progress: Progress) -> Iterator[Callback]:
    if callable(progress):
        yield progress
    else:
        with progress_bar(progress) as report:
            yield report
