"""The how-to for a new kind of job, followed to the letter in a copy of the tree.

Its three files are written out of its code blocks; then the kind is asked for in all ways: over
HTTP, with the client, on the command line, and from the list that the page shows.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.contract.howto import Followed, copy_tree, follow, page


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Followed:
    """Return a copy of the tree with the how-to's files."""
    tree = tmp_path_factory.mktemp("tree")
    copy_tree(tree, "solver", "service", "worker", "myoface", "tests")
    return follow(page("add-a-kind"), tree)


def test_the_files_of_the_how_to_are_in_style(followed: Followed) -> None:
    assert (len(followed.created), followed.changed) == (3, [])
    followed.check_style()


def test_its_test_passes(followed: Followed) -> None:
    followed.test(followed.created[2])


@pytest.mark.slow
def test_the_kind_is_there_for_everybody(followed: Followed, tmp_path: Path) -> None:
    followed.run(str(Path("tests", "contract", Path(__file__).name)), str(tmp_path))


def ask_in_all_ways(folder: Path) -> None:
    """Ask for the new kind; runs in the copy."""
    from myoface.client import Client
    from service.settings import Settings
    from tests.command_line import invoke
    from tests.service_client import running, served

    data = folder / "data"
    subject, rig = put_rig(Settings(data_dir=data), folder, served)
    with running(data, jobs="solver.jobs") as (stack, studio):
        bad = {"kind": "measure_rig", "subject_id": subject, "rig_id": rig}
        answer = studio.http.post("/v1/jobs", json={**bad, "options": {"least_mm": -1}})
        assert answer.status_code == 422, answer.text
        assert answer.json()["detail"] == "options.least_mm: -1 is less than the minimum of 0"
        done = studio.done("measure_rig", subject, rig_id=rig, options={"least_mm": 1})
        assert done["result"]["summary"] == {"moved_mm": {"smile": 3.0}}
        assert [each["name"] for each in done["result"]["artifacts"]] == ["measurement.json"]

        listed = {each["kind"]: each for each in studio.get(KINDS_ROUTE)["items"]}
        new = listed["measure_rig"]
        assert "rig" in new["reads"]
        assert not {"captures", "performance"} & set(new["reads"])  # a button of each rig
        with Client(stack.url, studio.key) as client:
            job = client.wait(client.submit("measure_rig", subject, rig_id=rig).id)
            assert job.state == "succeeded"

        shell = {"MYOFACE_API_KEY": studio.key, "MYOFACE_URL": stack.url}
        shown = invoke(env=shell, words=["jobs", "kinds", "measure_rig"])
        assert "skin that moves by less does not count" in " ".join(shown.output.split())

    out = folder / "measured"
    solve = ["solve", "measure-rig", str(folder / "rig.npz")]
    made = invoke([*solve, "--least-mm", "1", "-o", str(out)])
    assert made.exit_code == 0, made.output
    measured = json.loads((out / "measurement.json").read_text(encoding="utf-8"))
    assert measured == {"moved_mm": {"smile": 3.0}}


KINDS_ROUTE = "/v1/kinds"


def put_rig(settings: object, folder: Path, served: object) -> tuple[str, str]:
    """Put a subject with a model and a rig into a service that stands; return their ids."""
    from solver.mechanics.flesh import IDENTITY
    from solver.rig import ExpressionFit, Rig
    from tests.solver.block import head_block

    model = head_block()
    skin = model.skin.vertices + np.array([0.0, 3.0, 0.0])
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    none = np.zeros(len(skin))
    fit = ExpressionFit("smile", "train", a, np.zeros(5), skin, skin, none, 0, 1, 0.0, 0.0)
    model.save(folder / "model.npz")
    Rig(model, model.weights, (fit,)).save(folder / "rig.npz")
    with served(settings) as studio:  # type: ignore[operator]
        subject = studio.subject()
        smile = studio.capture(subject, "smile")
        files = studio.http.app.state.store.files

        def stored(*names: str) -> dict[str, str]:
            return {name: files.put(folder / name).sha256 for name in names}

        made = studio.submit("build_model", subject)
        studio.pretend(made, stored("model.npz"))
        job = studio.submit("fit_geometry", subject, captures=[smile])
        studio.pretend(job, stored("rig.npz"), rig={"subject_id": subject, "model_job_id": made})
        return subject, str(studio.job(job)["result"]["rig_id"])


if __name__ == "__main__":
    ask_in_all_ways(Path(sys.argv[1]))
