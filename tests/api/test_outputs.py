"""Outputs of the verbs: which files are refused before anything is computed, and how they are written."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from stimrig import identify
from stimrig.api.cli.commands import audit, explain
from stimrig.api.cli.commands import test as verb
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import check_outputs, make_folder, write


def test_devices_and_pipes_are_written_directly(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    pipe = tmp_path / "stdout"
    pipe.symlink_to(f"/dev/fd/{writer}")
    check_outputs([], Path("/dev/null"), Path("/dev/null"), pipe)
    write(pipe, "content")
    os.close(writer)
    assert os.read(reader, 100) == b"content" and pipe.is_symlink()
    os.close(reader)


@pytest.mark.parametrize("name", ["service.lock", "MODEL.json", "recordings/r.h5", "stimrig.db", "elsewhere.db-wal"])
def test_a_file_of_the_service_is_not_replaced(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "var" / "recordings").mkdir(parents=True)
    monkeypatch.setenv("STIMRIG_DATA_DIR", str(tmp_path / "var"))
    output = tmp_path / "var" / name
    if name.startswith("elsewhere"):
        output = tmp_path / name
        monkeypatch.setenv("STIMRIG_DATABASE_URL", f"sqlite:///{tmp_path}/elsewhere.db")
    output.write_bytes(b"kept")
    for command in (audit.export, verb.test):
        with pytest.raises(InputError, match=rf"{name}: it would replace a file of .*\. Give another name\."):
            command(output=output)
    assert output.read_bytes() == b"kept"
    assert not any((tmp_path / "var").glob("logs")), "no service was started"


def test_with_an_address_this_machine_s_settings_are_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("STIMRIG_TOKEN", "STIMRIG_ADMIN_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("STIMRIG_PORT", "abc")
    with pytest.raises(InputError, match="needs a token in STIMRIG_TOKEN"):
        verb.test(url="http://127.0.0.1:9")


def test_a_refused_command_makes_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    data, new = tmp_path / "absent.csv", tmp_path / "new" / "deep"
    check_outputs([], new / "story.html", new / "a.svg", new_folder=new)
    for wrong in ({"html": new / "falling.svg"}, {"own": Path("/nowhere/x.py")}, {}):
        with pytest.raises((InputError, identify.BadRecord, OSError)):
            explain.explain([data], figures=new, **wrong)
    with pytest.raises((InputError, identify.BadRecord, OSError)):
        verb.test(decide=[data], output=new / "r.h5")
    assert list(tmp_path.iterdir()) == []


def test_a_new_folder_is_made_where_a_link_leads(tmp_path: Path) -> None:
    link, folder = tmp_path / "link", tmp_path / "new" / "deep"
    link.symlink_to(folder)
    check_outputs([], link / "r.h5", new_folder=link)
    make_folder(link)
    write(link / "r.h5", "content")
    assert (folder / "r.h5").read_text() == "content"


def test_without_a_term_the_other_outputs_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = type("Plain", (str,), {"effects": ()})("the model")
    left = SimpleNamespace(add=[], deciding_experiment=None)
    explained = SimpleNamespace(left=left, to_dict=dict, improvement=SimpleNamespace(models=[plain]))
    monkeypatch.setattr(explain, "load_structure", lambda *_: (None, None, []))
    monkeypatch.setattr(identify, "explain", lambda *_: explained)
    output, own = tmp_path / "MODEL.json", tmp_path / "own.py"
    explain.explain([], output=output, own=own)
    assert output.read_text() == "the model" and not own.exists()
    assert f"{own} is not written: no free effect was found" in capsys.readouterr().err
