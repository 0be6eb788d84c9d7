import json

from solver.jobs import Task
from tests.standin.orders import draw, orders_of, work

SEVERITIES = {"good": [], "usable": ["warning"], "bad": ["error"]}


def run(task: Task) -> None:
    scan = task.inputs["scan"]
    landmarks = task.inputs.get("landmarks")
    work([scan], task.progress, ["read", "check", "pictures"])
    verdict = orders_of(scan).get("verdict", "good")
    options = {**task.options.model_dump(exclude_unset=True), "role": task.role}
    figures = {"landmarks": landmarks and landmarks.read_text(), "options": options}
    findings = [
        {
            "code": "scan.mouth",
            "severity": severity,
            "message": f"{scan} has no mouth",
            "advice": "turn the head towards the lower camera and scan again",
        }
        for severity in SEVERITIES[verdict]
    ]
    check = {"verdict": verdict, "findings": findings, "figures": figures}
    (task.out / "check.json").write_text(json.dumps(check))
    draw(task.out / "check.png", scan.name)
