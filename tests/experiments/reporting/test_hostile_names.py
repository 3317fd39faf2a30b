"""Names of outside in everything that is printed and written: literal, and nothing steers a
terminal, a page or a Markdown reader."""

import io
import json
import re
import sys
import unicodedata
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from rich.table import Table

from touchdown.experiments import terminal
from touchdown.experiments.cli import main as cli
from touchdown.experiments.errors import visible
from touchdown.experiments.reporting.tables import fenced, markdown_cell, markdown_text

from support.report_support import LANDING, write_run

NAMES = (
    "[/x]", "[bold red]x", "[link=file:///etc/passwd]y[/link]", ":boom:", "a\x1b[31mb", "a\rb\x08",
    "l\u202er", "z\u200bw", "line\n# heading\n| a |", "\x9b31m", "<script>alert(1)</script>",
    "[x](javascript:alert(1))", "![x](http://example.invalid/a.png)", "[x]: javascript:alert(1)",
    "# h", "- item", "1. item", "> quote", "a | b", "`", "``", "a`b", "*b*", "_i_", "~~s~~",
    r"$\frac{1}$", "$x", "&lt;b&gt;", "\\", "a\\`b", "<!--", "]]>", "--></style>", "=== x",
    "{{ 7 * 7 }}", "é ü 地", "_", "-->",
)  # fmt: skip


def _write(folder: Path, label: str, **changes: Any) -> None:
    """A run whose names are not those of its directory."""
    run = write_run(folder, label, "m", 0)
    result = json.loads((run / "result.json").read_text())
    (run / "result.json").write_text(json.dumps(result | changes))


def _is_quiet(text: str) -> bool:
    """True if no character but line ends and tabs steers a terminal or hides."""
    return all(c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cf", "Cs") for c in text)


def test_visible() -> None:
    assert visible("plain é 地 [x] ü") == "plain é 地 [x] ü"
    assert visible("\x1b\x07\x7f\x85\x9b\n\r\t") == r"\x1b\x07\x7f\x85\x9b\n\r\t"
    assert visible("\u202e\u2066\u200b\ufeff\u2028") == r"\u202e\u2066\u200b\ufeff\u2028"
    assert visible("\ud800\U000e0041") == r"\ud800\U000e0041"
    assert visible("a\nb\tc", keep="\n") == "a\nb\\tc" and visible(Path("a\x1bb")) == r"a\x1bb"


def test_lines_of_errors_and_warnings() -> None:
    line = terminal.error_line("'a\x1b[2Jb\u202e' is\nwrong")
    assert line == r"touchdown: error: 'a\x1b[2Jb\u202e' is wrong"
    assert terminal.warning_line("a\x1bb\nc") == r"touchdown: warning: a\x1bb c"
    assert len(terminal.error_line("\x1b" * 10_000)) < 800


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("method `livo` on flat: 0.1 [0.05, 0.2] m, p < 0.05", None),
        ("position_error_m of d_L, 10 000 resamples; a > b", None),
        ("<b>", r"\<b>"),
        ("[x](javascript:y)", r"[x\](javascript:y)"),
        ("[x]: y", r"[x\]: y"),
        ("*b* _i_ ~~s~~ $x$", r"\*b\* \_i\_ \~\~s\~\~ \$x\$"),
        ("&lt; & x", r"\&lt; & x"),
        ("# h", r"\# h"), ("- i", r"\- i"), ("12. i", r"12\. i"), ("> q", r"\> q"), ("=", r"\="),
        ("a\nb", r"a\\nb"), ("\x1b", r"\\x1b"), ("\\", "\\\\"),
        ("`a<b>`", "`a<b>`"), ("`a` <b> `c`", r"`a` \<b> `c`"),
        ("`a`b` <i>", r"\`a\`b\` \<i>"), ("``<b>``", r"\`\`\<b>\`\`"),
    ],
)  # fmt: skip
def test_markdown_text(text: str, shown: str | None) -> None:
    assert markdown_text(text) == (text if shown is None else shown)


def test_markdown_of_a_cell_and_of_code() -> None:
    assert markdown_cell("a|`b|c`") == r"a\|`b\|c`"
    assert fenced("a = 1\n```\n<b>\x1b") == ["````", "a = 1\n```\n<b>\\x1b", "````"]


@pytest.mark.parametrize("name", NAMES)
def test_console_prints_names_literally(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    console = terminal.make_console()
    table = Table(title=name)
    table.add_column(name)
    table.add_row(name)
    console.print(table)
    console.print(f"name: {name}", soft_wrap=True)
    terminal.say(name)
    terminal.make_notes(quiet=False)(name)
    terminal.make_progress(quiet=False)(1.0, name, name)
    captured = capsys.readouterr()
    assert captured.out.count(visible(name)) >= 4 - ("\n" in name) and visible(name) in captured.err
    assert _is_quiet(captured.out) and _is_quiet(captured.err)


def test_stdout_without_the_characters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsysbinary: Any
) -> None:
    """A terminal of Latin-1 gets escapes, not a traceback."""
    write_run(tmp_path, "é地", "m", 0)
    out = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(sys, "stdout", out)
    assert cli.main(["report", str(tmp_path)]) == 0
    out.flush()
    assert b"\xe9\\u5730" in out.buffer.getvalue()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    for number, name in enumerate(NAMES):
        other = NAMES[(number * 7 + 3) % len(NAMES)]
        _write(
            folder / "runs", f"r{number}", scene=name, estimator=other, outcome="LANDED",
            landing=LANDING, reason=name, git_revision=name, versions={"touchdown": name},
        )  # fmt: skip
    (folder / "runs" / "campaign.toml").write_text("```\n<script>\x1b[31m\n# h\n", encoding="utf-8")
    assert cli.main(["report", str(folder / "runs"), "--out", str(folder / "out")]) == 0
    return folder / "out"


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [(tag, f"{key}={value}") for key, value in attrs] or [(tag, "")]


def test_html_has_no_markup_of_names(report: Path) -> None:
    text = (report / "report.html").read_text(encoding="utf-8")
    assert _is_quiet(text)
    tags = _Tags()
    tags.feed(text)
    assert not {tag for tag, _ in tags.found} & {"script", "img", "iframe", "b>"}
    assert not [a for _, a in tags.found if "javascript" in a or a.startswith("on")]
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text and r"a\x1b[31mb" in text


def test_markdown_has_no_markup_of_names(report: Path) -> None:
    markdown = pytest.importorskip("markdown_it")
    text = (report / "report.md").read_text(encoding="utf-8")
    assert _is_quiet(text)
    page = markdown.MarkdownIt("gfm-like", {"linkify": False}).render(text)
    tags = _Tags()
    tags.feed(page)
    names = {tag for tag, _ in tags.found}
    assert names <= {
        "h1", "h2", "p", "ul", "li", "table", "thead", "tbody", "tr", "th", "td", "code", "pre",
        "strong", "em", "img",
    }, names  # fmt: skip
    pictures = [attribute for tag, attribute in tags.found if tag == "img"]
    assert all(a.startswith(("src=figures/", "alt=")) for a in pictures)
    assert page.count("<h2>") == len(re.findall(r"^## ", text, re.M))
    assert page.count("<h1>") == 1
    plain = re.sub("<[^>]*>", "", page)
    for name in ("&lt;script&gt;alert(1)&lt;/script&gt;", "[x](javascript:alert(1))", "a | b"):
        assert name in plain
    rows = re.findall(r"<tr>.*?</tr>", page, re.S)
    tables = re.findall(r"<table>.*?</table>", page, re.S)
    assert rows and all(
        len({len(re.findall("<t[hd]", row)) for row in re.findall(r"<tr>.*?</tr>", t, re.S)}) == 1
        for t in tables
    )
