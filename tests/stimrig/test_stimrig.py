"""`import stimrig`: quick to import, the names of the contract, results that show and draw themselves, progress."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import stimrig
from stimrig.api.progress_bar import in_notebook
from stimrig.errors import BadRequest
from tests.api.test_worker import made_up_csv

NAMES = {
    "read", "fit", "predict", "compare", "diagnose", "improve", "next_experiment", "effects", "plot", "Model", "Record",
    "Client",
}  # fmt: skip
HEAVY = {"numpy", "scipy", "numba", "h5py", "plotly", "httpx", "tqdm", "pydantic", "fastapi", "sqlalchemy"}


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> stimrig.Record:
    return stimrig.read(made_up_csv(tmp_path_factory.mktemp("stimrig") / "record.csv"))


@pytest.fixture(scope="module")
def model(record: stimrig.Record) -> stimrig.Model:
    return stimrig.fit(record)


def test_importing_it_loads_no_library() -> None:
    code = "import sys, stimrig; print(*{name.removeprefix('stimrig.').partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "identify" in loaded
    assert not HEAVY & set(loaded)


@pytest.mark.slow
def test_it_works_in_a_folder_with_packages_of_our_folders_names(tmp_path: Path) -> None:
    """Whatever a project of one's own calls its packages: all of ours are parts of `stimrig`."""
    for name in ("api", "rig", "identify", "hardware_sim", "tests"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('this is not stimrig')\n")
    code = "import stimrig; print(stimrig.fit, stimrig.Client, stimrig.effects()[0])"
    for command in (["-c", code], ["-m", "stimrig", "--version"], ["-m", "stimrig.rig", "--help"]):
        subprocess.run([sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, check=True)


def test_names_are_those_of_the_contract() -> None:
    assert set(stimrig.__all__) == NAMES | {"carry", "errors"}
    assert all(callable(getattr(stimrig, name)) for name in NAMES)
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        stimrig.fitt  # noqa: B018


def test_everything_in_it_stands_elsewhere() -> None:
    """Thin: a few lines a file, no computation, so that nothing can be done through it alone."""
    folder = Path(stimrig.__file__).parent
    assert sum(len(path.read_text().splitlines()) for path in folder.glob("*.py")) < 220
    assert not any("numpy" in path.read_text() for path in folder.glob("*.py"))


def test_a_model_shows_itself_in_a_notebook(model: stimrig.Model) -> None:
    html = model._repr_html_()
    assert html.startswith("<table>") and html.count("<tr>") > 4
    assert "N·m" in html and "<script" not in html
    assert str(model).splitlines()[0] in html


def test_a_model_draws_itself_beside_its_record(model: stimrig.Model, record: stimrig.Record) -> None:
    figure = model.plot(record)
    names = [trace.name for trace in figure.data]
    assert names[:3] == ["measured", "", "95 % band of the model"] and {"model, free run", "pulse width"} <= set(names)
    measured = figure.data[0]
    assert measured.x[0] == record.time_s[0] and max(measured.y) == pytest.approx(record.torque_nm.max(), abs=1e-4)
    curve = next(trace for trace in figure.data if trace.xaxis == "x2" and trace.name == "model")
    assert list(curve.y) == pytest.approx(list(model.recruitment.table()[1]))
    assert figure.layout.xaxis.domain[1] < figure.layout.xaxis2.domain[0]


def test_a_comparison_draws_what_is_left(model: stimrig.Model, record: stimrig.Record) -> None:
    against = stimrig.compare(model, record)
    (left,) = against.plot().data
    assert left.name == "measured − model"
    assert max(left.y) == pytest.approx(max(record.torque_nm - model.predict(record)), abs=0.05)


def test_what_cannot_be_drawn_says_what_can(model: stimrig.Model) -> None:
    for draw in (model.plot, lambda: stimrig.plot({})):
        with pytest.raises(BadRequest, match=r"plot\(model, record\)"):
            draw()


def test_effects_are_the_library() -> None:
    found = stimrig.effects()
    assert {"fatigue", "torque_angle"} <= {row["id"] for row in found}
    assert all(row["equation"] and row["source"] for row in found)


def test_next_experiment_tells_two_rivals_apart(record: stimrig.Record) -> None:
    found = stimrig.next_experiment(record, ["threshold_drift", "recruitment_hysteresis"])
    assert found is not None and found.rivals == ("threshold_drift", "recruitment_hysteresis")
    assert found.duration_s > 0 and found.to_dict()["segments"] == [dict(row) for row in found.segments]
    assert str(found).startswith("Next experiment: threshold_drift or recruitment_hysteresis")
    assert found.text in str(found)


def test_next_experiment_of_a_diagnosis_is_its_first_undecided_effect(record: stimrig.Record) -> None:
    diagnosis = stimrig.diagnose(record)
    undecided = [row for row in diagnosis.missing if row["confused_with"] and row["next_experiment_plan"]]
    found = stimrig.next_experiment(diagnosis)
    assert (found is None) == (not undecided)
    if found is not None:
        assert found.rivals == (undecided[0]["effect"], undecided[0]["confused_with"][0])
    with pytest.raises(TypeError, match="on a record"):
        stimrig.next_experiment(diagnosis, ["fatigue"])


@pytest.mark.parametrize(("progress", "told"), [(True, True), (False, False)])
def test_long_work_shows_a_bar_unless_it_is_turned_off(
    record: stimrig.Record, monkeypatch: pytest.MonkeyPatch, progress: bool, told: bool
) -> None:
    shown = io.StringIO()
    shown.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", shown)
    monkeypatch.setattr("stimrig.api.progress_bar.PATIENCE_S", 0.0)
    stimrig.fit(record, effects=["fatigue"], progress=progress)
    assert ("fitting fatigue" in shown.getvalue()) == told


def test_progress_may_be_a_function_of_ones_own(record: stimrig.Record) -> None:
    shares: list[float] = []
    stimrig.fit(record, effects=["fatigue"], progress=lambda share, _: shares.append(share))
    assert shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.parametrize(("config", "notebook"), [({"IPKernelApp": {}}, True), ({}, False)])
def test_a_notebook_is_known_by_its_kernel(
    monkeypatch: pytest.MonkeyPatch, config: dict[str, object], notebook: bool
) -> None:
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace(config=config)))
    assert in_notebook() == notebook
