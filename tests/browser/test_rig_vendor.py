"""The page's copy of three.js: what it says it is, and no more than the page uses."""

import hashlib
import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
STATIC = ROOT / "service" / "page" / "static"
VENDOR = STATIC / "vendor"
MOST_BYTES = 700_000


def test_the_bundle_is_the_one_that_was_made() -> None:
    made = json.loads((VENDOR / "VERSION.json").read_text())
    content = (VENDOR / "three.js").read_bytes()
    assert made["name"] == "three"
    assert re.fullmatch(r"\d+\.\d+\.\d+", made["version"])
    assert hashlib.sha256(content).hexdigest() == made["sha256"]
    assert len(content) < MOST_BYTES
    assert "The MIT License" in (VENDOR / "LICENSE").read_text()


def test_it_needs_nothing_that_the_policy_forbids() -> None:
    text = (VENDOR / "three.js").read_text()
    assert not re.search(
        r"\beval\(|\bnew Function\b|\bimport\(|^import\b", text, flags=re.MULTILINE
    )


def test_it_exports_what_the_page_uses_and_nothing_else() -> None:
    text = (VENDOR / "three.js").read_text()
    exported = set(re.findall(r" as (\w+)", text[text.rindex("export{") :]))
    used: set[str] = set()
    for script in (STATIC / "js").rglob("*.js"):
        for names in re.findall(
            r'import \{([^}]+)\} from "[^"]+vendor/three\.js"', script.read_text()
        ):
            used |= {name.strip() for name in names.split(",") if name.strip()}
    assert exported == used
