"""Names that several distributions give: none replaces another in silence."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import pytest

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.spec import SPEC
from ihbench.scene.method_spec import Command


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Put a distribution with entry points on the path, as pip leaves it there."""

    def put(distribution, group, *entries, place="site"):
        folder = tmp_path / place / f"{distribution.replace('-', '_')}-1.0.dist-info"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text("\n".join([f"[{registry.GROUPS[group]}]", *entries]))
        monkeypatch.syspath_prepend(tmp_path / place)
        forget()

    found = registry._found  # fixtures may lay others over it

    def forget():
        found.cache_clear()
        registry.clashes.cache_clear()

    yield put
    monkeypatch.undo()
    forget()


@pytest.mark.parametrize(
    ("kind", "name"),
    [("method", "inpainthuman"), ("report", "md"), ("occlusion", "natural"), ("metric preset", "ihbench")],
)
def test_a_later_package_does_not_replace_what_the_bench_has(install, kind, name):
    own = registry.entry_point(kind, name)
    install("zzz-theirs", kind, f"{name} = theirs:Thing")
    for use in (registry.entry_point, registry.load, registry.source, registry.package_folder):
        with pytest.raises(BadInput) as refusal:
            use(kind, name)
        text = str(refusal.value)
        assert f"{kind} {name!r} is registered by ihbench ({own.value}) and by zzz-theirs (theirs:Thing)" in text
        assert "uninstall" in text
    other = next(other for other in registry.names(kind) if other != name) if kind != "method" else None
    assert other is None or registry.entry_point(kind, other).module.startswith("ihbench")


def test_two_packages_of_others_clash_as_well(install):
    install("one", "method", "same = one:Method", "alone = one:Method")
    install("two", "method", "same = two:Method", place="another")
    with pytest.raises(BadInput, match=r"one \(one:Method\) and by two \(two:Method\)"):
        registry.load("method", "same")
    assert registry.entry_point("method", "alone").value == "one:Method"


def test_one_distribution_in_two_places_and_one_object_under_two_are_no_clash(install):
    install("one", "method", "same = one:Method")
    install("one", "method", "same = older:Method", place="another")
    install("fork", "report", "md = ihbench.reports.general.report:MARKDOWN")
    assert registry.clashes("method") == registry.clashes("report") == {}
    assert registry.load("report", "md") is not None


def test_the_list_and_the_help_name_clashes_and_go_on(install, bench, monkeypatch):
    install("zzz-theirs", "method", "inpainthuman = theirs:Thing")
    install("zzz-protocols", "protocol", "zju_occ = theirs:zju_occ.toml", place="b")
    commands = {"run": Command("theirs", "theirs:main"), **SPEC.commands}
    theirs = replace(SPEC, name="theirs", method="ihbench.x:X", profiles={}, commands=commands)
    monkeypatch.setattr("ihbench.methods.inpainthuman.spec.THEIRS", theirs, raising=False)
    install("zzz-command", "method", "theirs = ihbench.methods.inpainthuman.spec:THEIRS", place="c")
    outcome = bench("list")
    assert outcome.status == 0
    told = json.loads(bench("list", "--json").out)
    assert "zzz-theirs" in told["clashes"]["method inpainthuman"]
    assert "zzz-protocols" in told["clashes"]["protocol zju_occ"]
    assert "the bench's own is the one that runs" in told["clashes"]["command run"]
    assert "cannot be used" in told["methods"]["inpainthuman"]
    assert "novel_pose@1" in told["protocols"]
    assert "clashes" in outcome.out
    usage = bench("--help").out
    assert usage.count("\n  run ") == 1
    assert usage.count("\n  ceiling ") == 1  # of the one method that can be used


@pytest.mark.parametrize(("command", "group", "name"), [("run", "report", "md"), ("ablate", "table", "ablation")])
def test_a_clash_at_the_end_is_found_before_anything_is_fitted(install, bench, mannequin, command, group, name):
    install("zzz-theirs", group, f"{name} = theirs:write")
    words = [command, "--protocol", bench.protocol, "--runs", bench.runs, "--method", mannequin]
    outcome = bench(*words, *(["--vary", "brightness=0.1:0.2"] if command == "ablate" else []))
    assert outcome.status == 2
    assert "zzz-theirs" in outcome.err
    assert not bench.runs.exists()


THEIRS = """from ihbench.scene.method_spec import MethodSpec
SPEC = MethodSpec(name="theirs", title="T", summary="s", method="{}", profiles={{}}, commands={})"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (THEIRS.format("zzz_theirs:Method", {"mine": 3}), "command 'mine' is 3, expected a Command(summary, main)"),
        (THEIRS.format("zzz_theirs:Method", []), "has the commands []"),
        (THEIRS.format("another:Method", {}), "names another:Method, expected something of its own package"),
        ("SPEC = object", "is <class 'object'>, expected an ihbench.scene.method_spec.MethodSpec(name, title, "),
        ("from ihbench.methods.inpainthuman.spec import SPEC", "calls itself 'inpainthuman'"),
        ("raise OSError('no')", "cannot be loaded (package zzz-theirs): OSError('no')"),
    ],
)
def test_what_is_no_spec_of_its_method_is_refused(install, bench, tmp_path, monkeypatch, text, said):
    monkeypatch.delitem(sys.modules, "zzz_theirs", raising=False)
    install("zzz-theirs", "method", "theirs = zzz_theirs:SPEC")
    (tmp_path / "site" / "zzz_theirs.py").write_text(text)
    outcome = bench("run", "--protocol", bench.protocol, "--method", "theirs")
    assert (outcome.status, len(outcome.err.splitlines())) == (2, 1)
    assert said in outcome.err
    assert said in bench("list", "methods").out
