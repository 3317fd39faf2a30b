"""The page on untrusted files: its limits are those of the code, its kinds those that are
read."""

import re

from support.docs_support import rows_of, text_of

PAGE = "docs/trust.md"


def test_every_promise_has_tests() -> None:
    for promise, tests in rows_of(PAGE, "promise"):
        nodes = re.findall(r"`(tests/\S+)::(\w+)`", tests)
        assert nodes, promise
        for path, name in nodes:
            assert f"\ndef {name}(" in text_of(path), f"{promise}: {path} has no {name}"
