"""Files made to break a reader, by a seed: HDF5 that points elsewhere or declares too much, CSV without an end."""

from __future__ import annotations

import io
import json
import random
import warnings
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from operator import setitem
from pathlib import Path
from typing import Any

import h5py
import numpy as np

HEADER = b"time_s,pulse_width_us,torque_nm,segment\n"
SECRET = b"STIMRIG_ADMIN_TOKEN=the-secret-of-the-service " * 4000


@dataclass(frozen=True)
class Hostile:
    """One file; `refused` where nothing but a refusal is right."""

    name: str
    suffix: str
    content: bytes
    refused: bool = True


Change = Callable[[h5py.File, Path], Any]


def columns() -> dict[str, Any]:
    """A small sound recording: 16 s at 100 samples/s of a muscle that lags."""
    pulses = np.arange(640) / 40
    width = np.where(pulses < 1, 0.0, np.where(pulses < 9, 200.0 * (np.floor(pulses * 3) % 2), 100 + 10 * (pulses - 9)))
    time_s = np.arange(1600) / 100
    drive = np.interp(time_s, pulses, width) / 40
    torque = np.zeros(time_s.size)
    for k in range(1, time_s.size):
        torque[k] = torque[k - 1] + (drive[k] - torque[k - 1]) / 40
    torque += 0.02 * np.sin(np.arange(time_s.size) ** 1.7)
    return {
        "torque/time_s": time_s, "torque/torque_nm": torque, "torque/sync": np.full(time_s.size, 255, np.uint8),
        "pulses/planned_time_s": pulses, "pulses/sent_pulse_width_us": width,
        "pulses/written_time_s": np.where(width > 0, pulses + 0.001, np.nan),
        "pulses/acknowledged_time_s": np.where(width > 0, pulses + 0.002, np.nan),
        "pulses/status": np.where(width > 0, 0, 1).astype(np.uint8),
        "segments/start_s": np.array([0.0, 1.0, 9.0]), "segments/end_s": np.array([1.0, 9.0, 16.0]),
    }  # fmt: skip


def good(change: Change | None = None, folder: Path = Path(), libver: Any = None) -> bytes:
    """The sound recording's bytes, or with one thing changed."""
    target = io.BytesIO()
    with warnings.catch_warnings(), h5py.File(target, "w", libver=libver) as file:
        warnings.simplefilter("ignore")
        file.attrs.update(
            format="stimrig-recording", format_version=1, recording_id="R-1", test_id="T-1", pulse_rate_hz=40.0,
            content_sha256="0" * 64, created_utc="2026-01-01T00:00:00Z", outcome="completed", reason="",
        )  # fmt: skip
        for path, values in columns().items():
            file[path] = values
        file.create_dataset("segments/name", data=["rest", "prbs", "ramp"], dtype=h5py.string_dtype())
        if change is not None:
            change(file, folder)
    return target.getvalue()


def instead(path: str, make: Change) -> Change:
    """Something else in the place of a dataset or group."""

    def change(file: h5py.File, folder: Path) -> None:
        del file[path]
        make(file, folder)

    return change


def put(path: str, **how: Any) -> Change:
    """Another dataset."""
    return instead(path, lambda file, _: file.create_dataset(path, **how))


def cell(path: str, index: int, value: float) -> Change:
    """One value changed."""
    return lambda file, _: setitem(file[path], index, value)


def attribute(name: str, value: Any) -> Change:
    """One attribute changed."""
    return lambda file, _: setitem(file.attrs, name, value)


def link(path: str, to: Callable[[Path], Any]) -> Change:
    """A link in the place of a dataset or group."""
    return instead(path, lambda file, folder: setitem(file, path, to(folder)))


def external(path: str, target: Callable[[Path], str], size: int) -> Change:
    """A dataset whose bytes are those of another file."""

    def make(file: h5py.File, folder: Path) -> None:
        file.create_dataset(path, (size,), "u1", external=[(target(folder), 0, h5py.h5f.UNLIMITED)])

    return instead(path, make)


def virtual(path: str, target: Callable[[Path], str], inside: str, unlimited: bool = False) -> Change:
    """A dataset that is a view of another file's."""

    def make(file: h5py.File, folder: Path) -> None:
        most = (None,) if unlimited else None
        layout = h5py.VirtualLayout((1600,), "f8", maxshape=most)
        source = h5py.VirtualSource(target(folder), inside, (1600,), "f8", maxshape=most)
        whole = slice(h5py.h5s.UNLIMITED) if unlimited else slice(None)
        layout[whole] = source[whole] if unlimited else source
        file.create_virtual_dataset(path, layout)

    return instead(path, make)


def virtual_over_raw(file: h5py.File, folder: Path) -> None:
    """A virtual dataset over another file's external storage: what gave the administrator's token away."""
    with h5py.File(folder / "raw.h5", "w") as raw:
        raw.create_dataset("x", (1600,), "u1", external=[(str(folder / "secret.txt"), 0, h5py.h5f.UNLIMITED)])
    virtual("torque/torque_nm", lambda at: str(at / "raw.h5"), "x")(file, folder)


def deep(file: h5py.File, _folder: Path) -> None:
    """A path of 300 groups, and a group that holds itself."""
    group = file
    for _ in range(300):
        group = group.create_group("g")
    group["torque"] = file["torque"]
    file["torque/again"] = file["torque"]


def hdf5_shapes(folder: Path, only: Collection[str] = ()) -> Iterator[Hostile]:
    """Each way in which a recording may be something else, or `only` the named ones.

    `folder` holds what some of them point to: a secret, and a recording that nobody gave.
    """
    (folder / "secret.txt").write_bytes(SECRET)
    (folder / "other.h5").write_bytes(good())
    many = 10**12
    values = columns()
    torque, times = "torque/torque_nm", "torque/time_s"
    everywhere = (torque, times, "pulses/sent_pulse_width_us", "pulses/status", "segments/start_s", "segments/name")
    shapes: dict[str, Change] = {"virtual over raw storage": virtual_over_raw}
    for path in everywhere:
        shapes[f"external storage at {path}"] = external(path, lambda at: str(at / "secret.txt"), 1600)
        shapes[f"external link at {path}"] = link(path, lambda at, p=path: h5py.ExternalLink(str(at / "other.h5"), p))
        shapes[f"soft link at {path}"] = link(path, lambda _: h5py.SoftLink("/nowhere"))
        shapes[f"virtual at {path}"] = virtual(path, lambda at: str(at / "other.h5"), path)
        shapes[f"missing {path}"] = lambda file, _, p=path: file.__delitem__(p)
        shapes[f"group at {path}"] = lambda file, _, p=path: (file.__delitem__(p), file.create_group(p))
        shapes[f"a terabyte declared at {path}"] = put(path, shape=(many,), dtype="f8", chunks=(1000,))
        shapes[f"a terabyte without chunks at {path}"] = put(path, shape=(many,), dtype="f8")
        shapes[f"never written {path}"] = put(path, shape=(1600,), dtype="f8", fillvalue=1.0)
        shapes[f"scalar at {path}"] = put(path, data=1.0)
        shapes[f"nothing at {path}"] = put(path, data=h5py.Empty("f8"))
        shapes[f"two dimensions at {path}"] = put(path, data=np.ones((40, 40)))
        shapes[f"references at {path}"] = put(path, shape=(1600,), dtype=h5py.ref_dtype)
        shapes[f"regions at {path}"] = put(path, shape=(1600,), dtype=h5py.regionref_dtype)
        shapes[f"lists at {path}"] = put(path, shape=(1600,), dtype=h5py.vlen_dtype(np.float64))
        shapes[f"compound at {path}"] = put(path, data=np.zeros(1600, [("a", "f8"), ("b", "i4")]))
        shapes[f"opaque at {path}"] = put(path, data=np.zeros(1600, "V16"))
        shapes[f"booleans at {path}"] = put(path, data=np.zeros(1600, bool))
        shapes[f"complex at {path}"] = put(path, data=np.zeros(1600, complex))
        shapes[f"arrays at {path}"] = put(path, shape=(1600,), dtype=np.dtype(("f8", (1000,))))
    for target in ("/proc/self/environ", "/etc/passwd", "/dev/zero", "../stimrig.db"):
        shapes[f"external storage {target}"] = external(torque, lambda _, t=target: t, 1600)
    shapes |= {
        "virtual without an end": virtual(torque, lambda at: str(at / "other.h5"), torque, unlimited=True),
        "virtual of itself": virtual(torque, lambda _: ".", torque),
        "group elsewhere": link("torque", lambda at: h5py.ExternalLink(str(at / "other.h5"), "torque")),
        "soft link in a circle": link("torque", lambda _: h5py.SoftLink("/torque")),
        "soft link to a dataset inside": link("torque/torque_nm", lambda _: h5py.SoftLink("/torque/time_s")),
        "gzip bomb": put(torque, shape=(4_000_000,), dtype="f8", chunks=(4_000_000,), compression="gzip"),
        "chunks of one": put(torque, data=np.ones(200_000), chunks=(1,)),
        "other lengths": put(torque, data=np.ones(1599)),
        "no samples": lambda file, at: [put(p, data=np.ones(0))(file, at) for p in (torque, times)],
        "names of a megabyte": put("segments/name", data=["x" * 2**20] * 3, dtype=h5py.string_dtype()),
        "names of a line": put("segments/name", data=["rest\nprbs", "b", "c"], dtype=h5py.string_dtype()),
        "empty names": put("segments/name", data=["", "b", "c"], dtype=h5py.string_dtype()),
        "long plain names": put("segments/name", data=np.array([b"x" * 50_000] * 3)),
        "too few names": put("segments/name", data=["rest"], dtype=h5py.string_dtype()),
        "a million segments": put("segments/start_s", data=np.arange(1e6)),
        "segments backwards": put("segments/start_s", data=np.array([9.0, 1.0, 0.0])),
        "segments that end before they start": put("segments/end_s", data=np.array([-1.0, 1.0, 9.0])),
        "pulses backwards": put("pulses/planned_time_s", data=values["pulses/planned_time_s"][::-1].copy()),
        "other format": attribute("format", "other"),
        "format of numbers": attribute("format", np.arange(3)),
        "other version": attribute("format_version", 9),
        "version in words": attribute("format_version", "one"),
        "rate NaN": attribute("pulse_rate_hz", float("nan")),
        "rate of a gigahertz": attribute("pulse_rate_hz", 1e9),
        "rate zero": attribute("pulse_rate_hz", 0.0),
        "rate in words": attribute("pulse_rate_hz", "fast"),
        "two rates": attribute("pulse_rate_hz", [40.0, 40.0]),
        "rate of nothing": attribute("pulse_rate_hz", h5py.Empty("f8")),
        "name of a list": attribute("recording_id", ["a", "b"]),
        "name without an end": attribute("recording_id", "x" * 60_000),
    }
    for path in (torque, times, "pulses/planned_time_s", "pulses/sent_pulse_width_us", "segments/start_s"):
        index = 2 if path.startswith("segments") else 300
        for value in (np.inf, -1e300):
            shapes[f"{value} in {path}"] = cell(path, index, value)
    for name, change in shapes.items():
        if not only or name in only:
            yield Hostile(name, ".h5", good(change, folder))
    if only:
        return
    yield Hostile("deep and round", ".h5", good(deep, folder), refused=False)
    yield Hostile("sound", ".h5", good(), refused=False)
    yield Hostile("sound, newest layout", ".h5", good(libver="latest"), refused=False)
    yield Hostile("magic alone", ".h5", good()[:8])
    yield Hostile("magic and zeros", ".h5", good()[:8] + bytes(10_000))


def csv_shapes() -> Iterator[Hostile]:
    """Each way in which a table may be none, or too much."""
    sound = b"".join(b"%.4f,%d,%.3f,prbs\n" % (k / 40, 100 * (k // 20 % 2), k % 7) for k in range(400))
    row = b"0.0000,0,0,prbs\n"
    shapes = {
        "16 MB of newlines": HEADER + b"\n" * 16_000_000,
        "16 MB of carriage returns": HEADER + b"\r" * 16_000_000,
        "one line of 16 MB": HEADER + b"1" * 16_000_000,
        "a million columns": HEADER + b"1," * 1_000_000 + b"\n",
        "a million columns in the header": b"time_s," * 1_000_000 + b"\n" + sound,
        "a million rows of NaN": HEADER + b"nan,nan,nan,prbs\n" * 1_000_000,
        "a million equal rows": HEADER + row * 1_000_000,
        "an open quote": HEADER + b'"' + b"a\n" * 1_000_000,
        "quotes": HEADER + b'""""""""' * 200_000,
        "zeros": bytes(1_000_000),
        "nothing": b"",
        "blanks": b" \n" * 100_000,
        "digits of another script": HEADER + sound.decode().replace("1", "\u0661").encode(),
        "full-width digits": HEADER + sound.decode().replace("1", "\uff11").encode(),
        "underscores": HEADER + sound.replace(b"100,", b"1_00,"),
        "decimal commas": HEADER + sound.replace(b".", b",").replace(b",prbs", b";prbs"),
        "semicolons": (HEADER + sound).replace(b",", b";"),
        "UTF-16": (HEADER + sound).decode().encode("utf-16"),
        "half a sign": HEADER + sound + b"\xc3",
        "infinity": HEADER + sound.replace(b"6.000", b"1e400"),
        "hexadecimal": HEADER + sound.replace(b"6.000", b"0x10"),
        "names without an end": HEADER + b"".join(b"%.4f,0,0,n%d\n" % (k / 40, k) for k in range(100_000)),
        "a name of 9 kB": HEADER + sound + b"10.0,0,0," + b"x" * 9000 + b"\n",
        "pauses without an end": HEADER + b"".join(b"%.2f,0,0,r\n" % (k / 40 + 3 * (k // 9)) for k in range(40_000)),
        "eleven days": HEADER + sound + b"".join(b"%.4f,0,0,r\n" % (1e6 + k / 40) for k in range(400)),
        "time twice": HEADER + sound + sound,
        "cut": HEADER + sound[:-9],
        "a formula": HEADER + sound.replace(b"6.000", b"=1+1"),
        "decimal signs of both kinds": (HEADER + sound).replace(b",", b";").replace(b"6.000", b"6,000"),
        "numbers with commas between commas": HEADER + sound.replace(b"6.000", b'"6,000"'),
        "an eighth of the rows without a number": HEADER + sound.replace(b"6.000", b""),
        "comments without an end": HEADER + b"# 1\n" * 1_000_000,
        "a header that never comes": b"Channel 1;Channel 2;Channel 3\n" * 1_000_000,
        "names in every line": (b"Time,Torque,PW," * 600 + b"\n") * 500,
        "names in every bracket": (b"T[" * 4900 + b"\n") * 500,
        "samples that come and go": HEADER
        + b"".join(b"%.4f,%d,0,r\n" % (k / 40 + 0.2 * (k // 2), k % 3) for k in range(40_000)),
        "a time unit that is none": b"time [fortnights],pulse_width_us,torque_nm,segment\n" + sound,
        "UTF-16 cut": (HEADER + sound).decode().encode("utf-16")[:-1],
        "binary": random.Random(1).randbytes(1_000_000),
    }
    for name, content in shapes.items():
        yield Hostile(name, ".csv", content, refused=name not in ("semicolons", "UTF-16"))


def model_shapes() -> Iterator[Hostile]:
    """Each way in which a MODEL.json may be none; the sound one is fitted by whoever runs them."""
    knots = ",".join(str(k) for k in range(1_000_000))
    basis = '{"schema_version": "1.0", "method": "m", "pulse_rate_hz": 40, "sample_rate_hz": 40, "linear": %s, %s}'
    linear = '{"kind": "second-order", "time_constant_s": 0.5, "damping": 0.6}'
    spline = '"recruitment": {"basis": {"kind": "cubic-spline", "knots_us": [%s], "coefficients_nm": [%s]}}'
    sound = basis % (linear, spline % ("0,100,200,300", "0,1,2,3,4"))
    shapes = {
        "deep lists": "[" * 100_000,
        "deep objects": '{"a":' * 100_000 + "1" + "}" * 100_000,
        "40 MB of blanks": " " * 40_000_000,
        "a string without an end": '"' + '\\"' * 500_000,
        "a million knots": basis % (linear, spline % (knots, knots)),
        "NaN": sound.replace("0.5", "NaN"),
        "Infinity": sound.replace("0.5", "-Infinity"),
        "too large for a float": sound.replace("0.5", "1e999"),
        "digits without an end": sound.replace("0.5", "9" * 100_000),
        "a key twice": sound.replace('"damping"', '"time_constant_s"', 1),
        "delay of a billion": basis
        % ('{"b": [1], "a": [1], "delay_samples": 1000000000, "step_s": 0.025}', spline % ("0,300", "1,2,3")),
        "damping of a thing": sound.replace("0.6", json.dumps({"x": [1]})),
        "knots backwards": sound.replace("100,200", "200,100"),
        "true": "true",
        "nothing": "",
    }
    for name, content in shapes.items():
        yield Hostile(name, ".json", content.encode())
    yield Hostile("half a sign", ".json", b'{"\xc3": 1}')


def spoiled(rng: random.Random, number: int) -> Hostile:
    """The sound recording with bytes changed, doubled, or cut; it may still be one."""
    content = bytearray(good(libver="latest" if number % 3 == 0 else None))
    how = rng.choice(("flip", "flip", "flip", "word", "cut", "swap"))
    structure = [k for k in range(len(content)) if k < 4096 or k > len(content) - 4096]
    if how == "cut":
        del content[rng.randrange(9, len(content)) :]
    elif how == "swap":
        a, b = rng.randrange(8, len(content) - 512), rng.randrange(8, len(content) - 512)
        content[a : a + 256] = content[b : b + 256]
    else:
        for _ in range(rng.choice((1, 2, 8, 64))):
            at = rng.choice(structure[8:])
            size = 1 if how == "flip" else rng.choice((2, 4, 8))
            content[at : at + size] = rng.choice((b"\xff" * size, bytes(size), rng.randbytes(size)))[
                : len(content) - at
            ]
    return Hostile(f"{how} {number}", ".h5", bytes(content), refused=False)
