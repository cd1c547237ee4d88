"""The service under load and abuse: made-up requests on every route, fifty starts at once, bodies without an end."""

from __future__ import annotations

import concurrent.futures
import os
import socket
import time
from collections import Counter

import httpx
import hypothesis
import pytest
import schemathesis
from schemathesis.checks import CHECKS

from tests.api.conftest import TOKEN, Service, shared_service, wait_done

SEED = int(os.environ.get("STIMRIG_SEED", "20261120"))
EXAMPLES = int(os.environ.get("STIMRIG_EXAMPLES", "8"))
"""Of each operation; a hunt takes more."""
AUTHORIZED = {"Authorization": f"Bearer {TOKEN}"}
# A stop is open to any body by design; the controller's fetch and the page's form have their own tests.
CHECKED = ["not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance"]


abused = shared_service(speed=400.0)


def test_made_up_requests_meet_no_server_error(abused: Service) -> None:
    """Schemathesis over the OpenAPI document: every operation, a fixed seed, a bounded number of examples."""
    with abused.client() as client:
        client.post("/v1/participants", json={"code": "P017"})
        document = client.get("/openapi.json").json()
    schema = schemathesis.openapi.from_dict(document)
    schema.config.update(base_url=abused.url)
    tried: Counter[str] = Counter()
    failures: list[str] = []
    limits = hypothesis.settings(
        max_examples=EXAMPLES, deadline=None, database=None, derandomize=True,
        phases=[hypothesis.Phase.generate], suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    for result in schema.get_all_operations():
        operation = result.ok()

        @hypothesis.seed(SEED)
        @limits
        @hypothesis.given(case=operation.as_strategy())
        def attack(case: schemathesis.Case) -> None:
            answer = case.call(headers=AUTHORIZED, timeout=60)
            tried[case.operation.label] += 1
            try:
                case.validate_response(answer, checks=[CHECKS.get_one(name) for name in CHECKED])
            except schemathesis.core.failures.FailureGroup as group:
                failures.extend(f"{case.operation.label}: {failure}" for failure in group.exceptions)

        attack()
    assert failures == []
    assert len(tried) == sum(len(methods) for methods in document["paths"].values())


def test_fifty_starts_at_once_give_one_test_and_forty_nine_refusals(service: Service) -> None:
    service.rig.speed = 0.5  # it runs until all fifty are answered
    with service.client(limits=httpx.Limits(max_connections=50)) as client:
        client.post("/v1/participants", json={"code": "P017"})
        with concurrent.futures.ThreadPoolExecutor(50) as pool:
            answers = list(pool.map(lambda _: client.post("/v1/tests", json={"participant": "P017"}), range(50)))
        codes = Counter(answer.status_code for answer in answers)
        assert codes == {202: 1, 409: 49}
        (winner,) = [answer.json()["id"] for answer in answers if answer.status_code == 202]
        for answer in answers:
            if answer.status_code == 409:
                problem = answer.json()
                assert answer.headers["content-type"] == "application/problem+json"
                assert problem["holder"]["test_id"] == winner and winner in problem["detail"]
        assert service.rig.starts == 1
        assert len(client.get("/v1/tests").json()) == 1
        service.rig.speed = 30.0
        assert wait_done(client, winner)["state"] == "completed"


@pytest.mark.parametrize("path", ["/v1/participants/P017/recordings", "/v1/participants", "/v1/stop"])
def test_a_body_without_an_end_is_not_taken_in(service: Service, path: str) -> None:
    """A client that never stops sending is cut off; the service answers others meanwhile."""
    service.app.state.context.settings.max_upload_mb = 1.0
    with service.client() as client:
        client.post("/v1/participants", json={"code": "P017"})
        seen = client.get("/v1/participants/P017").headers["etag"]
        host, port = service.url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=10) as line:
            head = f"POST {path} HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {TOKEN}\r\n"
            head += f"If-Match: {seen}\r\n"
            line.sendall(f"{head}Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n".encode())
            chunk = b"10000\r\n" + b"x" * 65536 + b"\r\n"
            sent, end = 0, time.monotonic() + 8
            answer = b""
            line.settimeout(0.01)
            while time.monotonic() < end and not answer and sent < 40 * 65536:
                try:
                    line.sendall(chunk)
                    sent += 65536
                    answer = line.recv(4096)
                except TimeoutError:
                    continue
                except OSError:
                    break
            line.settimeout(5)
            if not answer:
                try:
                    answer = line.recv(4096)
                except OSError:
                    answer = b""
        if path == "/v1/stop":
            assert answer.startswith(b"HTTP/1.1 200") and service.rig.stopped_by, "a stop is a stop"
        else:
            assert answer.startswith(b"HTTP/1.1 413") and b"application/problem+json" in answer, answer[:200]
        assert client.get("/health").status_code == 200
        assert not list((service.data / "recordings").rglob("upload-*"))
