"""Learn a torque from trial to trial (docs/controllers.md). The environment has KEY, and URL if it is elsewhere."""

import csv
import json
import math
import os
import signal
import sys
import time
import urllib.error
import urllib.request

URL, KEY, CODE = os.environ.get("URL", "http://127.0.0.1:8000"), os.environ["KEY"], "P017"
playing = False  # a trial may be playing: whoever ends now presses stop


class Refused(Exception):
    """The service has understood and said no: nothing was begun."""


def request(path, body=None, **head):
    """Send a request; return the answer's text and its ETag."""
    data = None if body is None else json.dumps(body).encode()
    head |= {"Authorization": f"Bearer {KEY}", "Content-Type": "application/json"}
    try:
        with urllib.request.urlopen(urllib.request.Request(URL + path, data, head), timeout=60) as answer:
            return answer.read().decode(), answer.headers["ETag"]
    except urllib.error.HTTPError as refused:
        if refused.code >= 500:
            raise
        problem = json.load(refused)
        raise Refused(problem["type"] + ": " + problem["detail"]) from None


def stop():
    """Press stop; say so where that does not get through."""
    try:
        request("/v1/stop", {})
    except BaseException:
        print("STOP WAS NOT CONFIRMED: use the emergency switch on the stimulator now", file=sys.stderr, flush=True)
        raise


def must_look():
    """Return why a person has to look before the next trial; None: the muscle is still as it was approved."""
    followed = json.loads(request(f"/v1/participants/{CODE}/model?tracked=true")[0]).get("tracking") or {}
    return followed.get("ask")


def start(body):
    """Start a trial; its test."""
    global playing
    for _ in range(200):
        try:
            playing = True
            return json.loads(request("/v1/tests", body, **{"If-Match": etag})[0])
        except Refused as refused:
            playing = False
            if "rest-needed" not in str(refused):
                raise
            time.sleep(0.3)  # the rig wants a rest between trials
    raise SystemExit("the rig does not get its rest")


def play(widths_us):
    """Play a trial and wait for its end; mean torque above rest in each pulse's period, N·m."""
    global playing
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}}
    trial = {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": widths_us}}
    body = {"participant": CODE, "kind": "sequence", "pulse_rate_hz": rate_hz, "segments": [rest, trial, rest]}
    test = start(body)
    while not test["done"]:
        time.sleep(0.3)
        test = json.loads(request("/v1/tests/" + test["id"])[0])
    playing = False
    if test["state"] != "completed":
        raise SystemExit(test["reason"])
    rows = list(csv.DictReader(request(f"/v1/recordings/{test['recording_id']}/csv")[0].splitlines()))
    samples = [[] for _ in range(len(widths_us) + 1)]  # the last one is the rest before the trial
    for row in rows:
        period = math.floor((float(row["time_s"]) - 1.0) * rate_hz)
        if period < len(widths_us):
            samples[max(period, -1)].append(float(row["torque_nm"]))
    *torque_nm, zero_nm = [sum(period) / len(period) for period in samples]
    return [value - zero_nm for value in torque_nm]


for number in (signal.SIGINT, signal.SIGTERM):  # a shell's background job begins with Ctrl-C ignored
    signal.signal(number, lambda *_: sys.exit(1))
answer, etag = request(f"/v1/participants/{CODE}/model")
model = json.loads(answer)
rate_hz = model["pulse_rate_hz"]
size = round(4 * rate_hz)
peak_nm = 0.5 * model["recruitment"]["inverse"]["torque_nm"][-1]
reference_nm = [peak_nm * math.sin(math.pi * k / size) ** 2 for k in range(size)]
asked_nm = reference_nm
try:
    for number in range(1, 7):
        body = {"reference_torque_nm": asked_nm}
        plan = json.loads(request(f"/v1/models/{model['model_id']}/widths", body)[0])
        torque_nm = play(plan["pulse_width_us"])
        error_nm = [want - got for want, got in zip(reference_nm, torque_nm, strict=True)]
        rms = math.sqrt(sum(e * e for e in error_nm) / sum(r * r for r in reference_nm))
        print(f"trial {number}: {100 * rms:.1f} %", flush=True)
        if why := must_look():
            raise SystemExit(f"a person has to look first: {why}")
        near = [error_nm[max(0, k - 3) : k + 4] for k in range(size)]  # smoothed: noise is not learnt
        asked_nm = [max(0.0, r + 0.7 * sum(e) / len(e)) for r, e in zip(asked_nm, near, strict=True)]
finally:
    if playing:
        stop()
