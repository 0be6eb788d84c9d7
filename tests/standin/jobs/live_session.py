"""A session whose face is the numbers that it is given."""

import json
import os
import signal
import time

from solver.jobs import Task
from solver.kinds.live_messages import RESUMED, FollowedFrame, GivenFrame, Message, MessageError
from solver.kinds.live_session import PART, REPORT


def run(task: Task) -> None:
    channel = task.channel
    assert channel is not None

    def say(**words: object) -> None:
        channel.send(Message.of(words))

    say(type="preparing", phase="skin", fraction=0.5)
    for name in ("live_skin.npz", "live_samples.npz"):
        (task.out / name).write_text("of the rig")
    layout = [{"name": "values", "shape": [3]}]
    say(type="ready", source=task.options.source, expects={"rows": 3, "width": 1}, layout=layout)
    report = task.out / REPORT
    takes = json.loads(report.read_text())["takes"] if task.resume and report.is_file() else []
    figures = {"frames": 0, "takes": takes, "inputs": sorted(task.inputs), "resume": task.resume}
    recorded: list[int] = []
    name = None
    for part in task.out.glob(f"*{PART}") if task.resume else ():
        part.rename(task.out / part.stem)
        takes.append(part.name.split(".")[0])
    flags = 0
    heard = time.monotonic()
    while time.monotonic() - heard < task.options.idle_seconds:
        message = channel.receive(0.1)
        if message is None:
            continue
        words = json.loads(message.data) if message.is_text else {}
        if words.get("resume"):
            last = FollowedFrame.unpack(channel.receive(5).data)
            flags = RESUMED
            figures["resumed_from"] = last.number
        if "sleep" in words:
            time.sleep(words["sleep"])
        if "kill" in words:
            os.kill(os.getpid(), signal.SIGKILL)
        if "deaf" in words:
            time.sleep(100)
        if "record" in words:
            name = words["record"]
            recorded = []
            (task.out / f"{name}.csv{PART}").touch()
            say(type="recording", name=name)
        if "stop" in words and name:
            file = f"{name}.csv"
            (task.out / file).write_text("\n".join(map(str, recorded)))
            takes.append(name)
            report.write_text(json.dumps({"takes": takes}))
            (task.out / f"{file}{PART}").unlink()
            say(type="take", name=name, file=file, frames=len(recorded), seconds=1.0)
            name = None
        if "end" in words:
            break
        if message.is_text:
            continue
        heard = time.monotonic()
        try:
            given = GivenFrame.unpack(message.data)
        except MessageError as error:
            say(type="fault", code="live.frame", message=str(error), number=0)
            continue
        told = (1.0, 0.1, 0.2, 0, flags)  # what it took, its error, and what was dropped
        followed = FollowedFrame(given.number, given.seconds, *told, given.numbers)
        channel.send(Message(followed.pack()))
        flags = 0
        figures["frames"] += 1
        recorded.append(given.number)
    say(type="ended", reason="end")
    report.write_text(json.dumps(figures))
