import json

from solver.jobs import Task
from tests.standin.jobs.check_scan import SEVERITIES
from tests.standin.orders import orders_of, work


def run(task: Task) -> None:
    take = task.inputs["markers"]
    work([take], task.progress, ["read", "check", "pictures"])
    verdict = orders_of(take).get("verdict", "good")
    findings = [
        {
            "code": "markers.swapped",
            "severity": severity,
            "message": "LipL and LipR change places",
            "advice": "give the labels back their names",
        }
        for severity in SEVERITIES[verdict]
    ]
    if "rig" in task.inputs:
        (task.out / "markers.json").write_text("places")
    (task.out / "check.json").write_text(json.dumps({"verdict": verdict, "findings": findings}))
