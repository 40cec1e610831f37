"""The alert rules and the dashboard, judged by Prometheus itself on the metrics of a served panel."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import httpx
import pytest

from controller.kiosk.store.accounts import Role
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, served
from tests.ports import kept_port
from tests.waiting import eventually

FOLDER = Path(__file__).parents[4] / "docs" / "examples" / "monitoring"
pytestmark = pytest.mark.skipif(
    shutil.which("prometheus") is None or shutil.which("promtool") is None,
    reason="needs prometheus (a package of the test set-up)",
)
USED = re.compile(r"\bvelatura_\w+")


def promtool(*words: str) -> None:
    done = subprocess.run(["promtool", *words], cwd=FOLDER, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def told_by_promtool(text: str) -> list[str]:
    done = subprocess.run(["promtool", "check", "metrics"], input=text, text=True, capture_output=True, check=False)
    return done.stderr.splitlines()


def expressions() -> list[str]:
    dashboard = json.loads((FOLDER / "dashboard.json").read_text())
    drawn = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    rules = re.findall(r"^ +expr: (.+)$", (FOLDER / "alerts.yml").read_text(), re.MULTILINE)
    assert len(drawn) >= 8
    assert len(rules) >= 5
    return [*drawn, *rules]


def test_promtool_accepts_the_rules_and_each_fires_when_it_should() -> None:
    promtool("check", "rules", "alerts.yml")
    promtool("test", "rules", "alerts_test.yml")
    rules = re.findall(r"alert: (\w+)", (FOLDER / "alerts.yml").read_text())
    tested = (FOLDER / "alerts_test.yml").read_text()
    assert all(f"alertname: {rule}\n" in tested for rule in rules), "each rule has a case in which it fires"


def metrics(panel: Served) -> str:
    with panel.client() as client:
        return client.get("/metrics", headers=panel.token(Role.VIEWER)).text


def test_every_metric_that_is_used_is_there_and_promtool_accepts_them(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    with served(kiosk, tmp_path / "private") as panel:
        text = metrics(panel)
        kiosk.brightness(40)
        assert "velatura_brightness_ratio 0.4" in metrics(panel)
    # Lamps are counted in hours everywhere: in the trade, in the panel, and in the projector's own menu.
    assert told_by_promtool(text) == ['velatura_lamp_hours use base unit "seconds" instead of "hours"']
    present = set(USED.findall(text))
    assert {name for expression in expressions() for name in USED.findall(expression)} <= present
    kiosk.close()


def test_prometheus_reads_the_panel_and_sees_the_problem_of_a_projector(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    with served(kiosk, tmp_path / "private") as panel, kept_port() as port:
        token = panel.token(Role.VIEWER)["authorization"].removeprefix("Bearer ")
        (tmp_path / "prometheus.yml").write_text(
            "global: {scrape_interval: 1s, evaluation_interval: 1s}\n"
            f"rule_files: [{FOLDER}/alerts.yml]\n"
            "scrape_configs:\n"
            "  - job_name: velatura\n"
            f"    authorization: {{credentials: {token}}}\n"
            f"    static_configs: [{{targets: ['{panel.address.removeprefix('http://')}']}}]\n"
        )
        command = ["prometheus", f"--config.file={tmp_path}/prometheus.yml", f"--storage.tsdb.path={tmp_path}/data",
                   f"--web.listen-address=127.0.0.1:{port}"]  # fmt: skip
        with (tmp_path / "log").open("w") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            address = f"http://127.0.0.1:{port}/api/v1"

            def found(path: str, **query: str) -> Any:
                try:
                    return httpx.get(f"{address}/{path}", params=query, trust_env=False).json()["data"]
                except (httpx.HTTPError, KeyError, ValueError):
                    return {}

            def alerts() -> list[Any]:
                return list(found("alerts").get("alerts", []))

            assert eventually(alerts, every_s=0.2), (tmp_path / "log").read_text()
            (alert,) = alerts()
            assert (alert["labels"]["alertname"], alert["labels"]["device"]) == ("VelaturaDeviceProblem", "right")
            for expression in expressions():
                answer = found("query", query=expression.replace("$instance", ".*"))
                assert answer.get("resultType") == "vector", expression
            up = found("query", query='up{job="velatura"}')["result"]
            assert [row["value"][1] for row in up] == ["1"]
        finally:
            process.terminate()
            process.wait(20)
    kiosk.close()
