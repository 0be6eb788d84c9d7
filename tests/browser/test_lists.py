"""The page's lists: rigs with verdicts, webhooks with their log, the audit log."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.browser.stage import on_stage
from tests.receiver import LOOPBACK, receiving
from tests.service_client import Studio

pytestmark = pytest.mark.slow
Show = Callable[..., Any]


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A stack that may tell this machine."""
    folder = tmp_path_factory.mktemp("told")
    with on_stage(folder, webhook_workers=1, webhook_allow=LOOPBACK) as (_stack, studio):
        yield studio


def test_addresses_are_served_as_they_are_typed(show: Show) -> None:
    for path, heading in (
        ("/queue", "Queue"),
        ("/jobs", "Queue"),
        ("/rigs", "Rigs"),
        ("/audit", "Audit log"),
    ):
        show(path).locator("h1").get_by_text(heading).wait_for()
    page = show("/markers/%E0%A4%A")
    page.get_by_text("which is no id").wait_for()
    page.get_by_role("link", name="All subjects").click()
    page.locator("h1").get_by_text("Subjects").wait_for()
    page = show("/rigs/5f1b")
    page.get_by_text("which is no id").wait_for()
    page.get_by_role("link", name="All rigs").click()
    page.locator("h1").get_by_text("Rigs").wait_for()


def test_people_of_one_name_can_be_told_apart(show: Show, studio: Studio) -> None:
    ids = [studio.post("/v1/subjects", name="Robin")["id"] for _ in range(2)]
    page = show("/upload")
    choices = page.get_by_label("Subject", exact=True).locator("option")
    for identifier in ids:
        choices.get_by_text(f"Robin ({identifier[:8]}, ").wait_for(state="attached")
    page = show("/subjects")
    for identifier in ids:
        page.get_by_role("row", name=identifier[:8]).wait_for()


def test_markup_in_a_name_is_shown_as_text(show: Show, studio: Studio) -> None:
    name = "<img src=x onerror=document.title='gotcha'><b>Robin</b>"
    studio.post("/v1/subjects", name=name)
    page = show("/subjects")
    page.get_by_text(name).first.wait_for()
    assert page.locator("img[src=x]").count() == 0
    assert page.title() != "gotcha"


def test_only_who_types_the_name_deletes_a_person(show: Show, studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Zoë-Ann (2/3) [b]  x")
    page = show(f"/subjects/{subject['id']}")
    page.get_by_role("button", name="Delete subject").click()
    typed = page.get_by_label("To be sure, type the name")
    agreed = page.get_by_role("button", name="Delete for good")
    for name in ("Zoë", "zoë-ann (2/3) [b] x"):
        typed.fill(name)
        agreed.click()
        assert typed.evaluate("input => input.validationMessage").startswith("Type Zoë-Ann")
    typed.fill("Zoë-Ann (2/3) [b] x")
    agreed.click()
    page.get_by_text("is deleted").wait_for()


def test_an_answer_that_breaks_off_is_asked_for_again(show: Show, studio: Studio) -> None:
    subject = studio.modelled()
    long = studio.capture(subject, "long", seconds="60")
    job = studio.submit("fit_geometry", subject, captures=[long])
    page = show(f"/jobs/{job}")
    page.locator(".head .state").get_by_text("Running").wait_for()
    asked = f"**/v1/jobs/{job}"
    cut = {"status": 200, "content_type": "application/json", "body": '{"id": "'}
    with page.expect_response(asked):
        page.route(asked, lambda route: route.fulfill(**cut))
    studio.post(f"/v1/jobs/{job}/cancel", reason="the test is over")
    with page.expect_response(asked):
        page.get_by_text("was deleted").wait_for(state="hidden")
    page.unroute(asked)
    page.locator(".head .state").get_by_text("Canceled").wait_for()


def test_a_webhook_is_added_tried_and_deleted(show: Show, studio: Studio) -> None:
    with receiving() as (port, _):
        url = f"http://127.0.0.1:{port}/hook"
        page = show("/webhooks")
        page.get_by_text("Nobody is told").wait_for()
        page.get_by_role("button", name="Add a webhook").click()
        dialog = page.get_by_role("dialog")
        dialog.get_by_label("Address").fill(url)
        dialog.get_by_label("A job fails").check()
        dialog.get_by_role("button", name="Add it").click()
        assert page.get_by_role("textbox", name="The secret").input_value().startswith("whsec_")
        page.get_by_role("button", name="I have it").click()
        page.get_by_role("link", name=url).click()
        page.get_by_text("A job fails").wait_for()
        page.get_by_role("button", name="Send a test").click()
        page.locator("tbody tr").get_by_text("Delivered").wait_for()
        page.get_by_role("button", name=re.compile("Send again")).click()
        page.locator("tbody tr").nth(1).get_by_text("Delivered").wait_for()
        page.get_by_label("State").select_option("failed")
        page.get_by_text("Nothing was sent").wait_for()
        page.get_by_role("button", name="Switch off").click()
        page.get_by_role("button", name="Switch on").wait_for()
        page.get_by_role("button", name="Delete").click()
        page.get_by_role("dialog").get_by_role("button", name="Delete it").click()
        page.get_by_text("Nobody is told").wait_for()
    page = show("/audit")
    page.get_by_text("Webhook created").wait_for()
    about = page.get_by_role("row", name="Webhook deleted").get_by_role("link").inner_text()
    page.get_by_label("Only about the id").fill(about)
    page.get_by_role("button", name="Find").click()
    page.wait_for_url(f"**/audit?object_id={about}")
    page.get_by_text("Webhook created").wait_for()


def test_only_a_key_that_may_sees_webhooks_and_the_audit_log(show: Show, studio: Studio) -> None:
    key = studio.post("/v1/keys", name="station", scopes=["read", "write"])["key"]
    page = show("/rigs", key=key)
    page.locator("h1").get_by_text("Rigs").wait_for()
    assert page.get_by_role("link", name="Audit log").count() == 0
    assert page.get_by_role("link", name="Webhooks").count() == 0
    page = show("/rigs")
    page.get_by_role("link", name="Audit log").wait_for()
