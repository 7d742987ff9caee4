"""The HTML page: complete in itself, and true to its input."""

import base64
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pytest

from fitting.acoustics.lines import SeenPeak
from fitting.acoustics.poles import ExcitationPeak
from fitting.cane.sweep_fit import ReedFit
from reports.errors import OutputRefusedError
from reports.run_page import (
    _peaks_hz,
    write_bare_report,
    write_report,
)
from runs.errors import RunFileError

VOID = {"meta", "img", "br"}
NASTY = '<b>&"R07"</b>$\\frac$\x1b]0;x\x07'
SHOWN = '<b>&"R07"</b>$\\frac$\\x1b]0;x\\x07'


class Page(HTMLParser):
    """Collects text, images and links, and notices tags that are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.images, self.links, self.tags = [], [], [], [], []
        self.declarations = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_decl(self, decl):
        self.declarations.append(decl)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        values = dict(attrs)
        if tag == "html":
            assert values["lang"] == "en"
        if tag == "th":
            assert values["scope"] in ("col", "row")
        if tag == "img":
            self.images.append(values["src"])
            assert values["alt"]
        self.links += [values[key] for key in ("href", "src") if key in values]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def written(fitted, tmp_path_factory):
    page = tmp_path_factory.mktemp("report") / "R07.html"
    return write_report(fitted, page)


@pytest.fixture(scope="module")
def page(written):
    return Page(written["report"].read_text(encoding="utf-8"))


def test_files_are_where_it_says(written):
    assert sorted(written) == ["contact sheet", "report", "response"]
    for name, file in written.items():
        assert file.parent == written["report"].parent
        start = b"<!doctype html>" if name == "report" else b"\x89PNG"
        assert file.read_bytes().startswith(start)
    assert set(written["report"].parent.iterdir()) == set(written.values())


def test_the_page_needs_nothing_else(written, page):
    text = written["report"].read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    assert "url(" not in text
    assert page.declarations == ["doctype html"]
    assert {"title", "h1"} <= set(page.tags)
    assert "script" not in page.tags
    assert "link" not in page.tags
    assert all(link.startswith("data:image/png;base64,") for link in page.links)


def test_the_page_holds_the_very_pictures_of_its_folder(written, page):
    held = [base64.b64decode(image.split(",")[1], validate=True) for image in page.images]
    assert held == [written["contact sheet"].read_bytes(), written["response"].read_bytes()]


def test_the_page_gives_modes_components_and_moduli(fitted, page):
    sweep, parameters = fitted.sweeps[0], fitted.parameters
    assert "Reed R07, series A" in page.text
    for name, found in sweep.resonances.items():
        row = f"{name} {found.frequency_hz:.1f} {found.error_cents:.1f} {found.step_index}"
        assert row in page.text
    for name, estimate in parameters.components.items():
        assert f"{name} {estimate.value:+.2f} {estimate.error:.2f}" in page.text
    moduli = parameters.moduli["A"]
    modulus = moduli["E1_mpa"]
    assert f"E1, series A {modulus.value:.0f} {modulus.error:.0f} MPa" in page.text
    assert f"{parameters.rms_cents:.1f} cents" in page.text
    assert "87 of 87 steps good" in page.text
    assert "negative constant" not in page.text


def test_modes_that_were_not_fitted_are_reported(fitted, tmp_path):
    residual = dict(fitted.parameters.residual_cents["A"])
    residual.pop("X1")
    parameters = replace(fitted.parameters, residual_cents={"A": residual})
    files = write_report(replace(fitted, parameters=parameters), tmp_path / "page.html")
    text = Page(files["report"].read_text(encoding="utf-8")).text
    assert text.count(" not fitted") == 1


def test_what_people_wrote_is_text_and_never_markup(fitted, changed, tmp_path):
    labels = {"note": f"<script>alert(1)</script> {NASTY}", "name": NASTY}
    run = changed(only=(19, 35), **labels)
    sweep = replace(fitted.sweeps[0], reed=NASTY, path=run)
    files = write_report(ReedFit((sweep,), None, f"because of {NASTY}"), tmp_path / "page.html")
    page = Page(files["report"].read_text(encoding="utf-8"))
    assert {"script", "b"}.isdisjoint(page.tags)
    assert f"Reed {SHOWN}, series A" in page.text
    assert f"<script>alert(1)</script> {SHOWN}" in page.text
    assert f"No parameters: because of {SHOWN}" in page.text


def test_springs_outside_physics_are_reported(fitted, tmp_path):
    parameters = replace(fitted.parameters, physical=False)
    files = write_report(replace(fitted, parameters=parameters), tmp_path / "page.html")
    assert "negative constant" in files["report"].read_text(encoding="utf-8")


def test_both_series_have_pictures_of_their_own(fitted, changed, tmp_path):
    first = fitted.sweeps[0]
    second = replace(first, path=changed("B.h5", only=(19, 35)), series="B")
    files = write_report(ReedFit((first, second), None, "drawn only"), tmp_path / "page.html")
    names = ["contact sheet A", "contact sheet B", "report", "response A", "response B"]
    assert sorted(files) == names
    assert len(set(files.values())) == 5
    assert len(Page(files["report"].read_text(encoding="utf-8")).images) == 4


def test_runs_of_one_name_in_two_folders_do_not_overwrite_each_other(fitted, changed, tmp_path):
    first = fitted.sweeps[0]
    other = changed(first.path.name, only=(19, 35))
    assert other.name == first.path.name
    fit = ReedFit((first, replace(first, path=other, series="B")), None, "drawn only")
    files = write_report(fit, tmp_path / "page.html")
    assert len(set(files.values())) == 5


def test_a_report_is_replaced(fitted, tmp_path):
    page = tmp_path / "page.html"
    write_bare_report([fitted.sweeps[0].path], page, "no fit yet")
    assert "no fit yet" in page.read_text(encoding="utf-8")
    for _ in range(2):
        write_report(fitted, page)
    assert "no fit yet" not in page.read_text(encoding="utf-8")


def test_a_report_never_replaces_its_run(fitted, changed):
    run = changed(only=(19, 35))
    before = run.read_bytes()
    sweep = replace(fitted.sweeps[0], path=run)
    link, other_name = run.with_name("link.html"), run.with_name("page.html")
    link.symlink_to(run)
    other_name.hardlink_to(run)
    for page in (run, link, other_name):
        with pytest.raises(OutputRefusedError, match="is an input"):
            write_report(ReedFit((sweep,), None, ""), page)
        with pytest.raises(OutputRefusedError, match="is an input"):
            write_bare_report([run], page, "no fit")
    assert run.read_bytes() == before, "the run file is destroyed"


def test_a_folder_that_is_not_there_is_an_error_of_one_line(fitted, tmp_path):
    with pytest.raises(OutputRefusedError, match=r"cannot be written.*--out") as refused:
        write_report(fitted, tmp_path / "no" / "page.html")
    assert "\n" not in str(refused.value)


def test_a_run_that_is_gone_is_an_error(fitted, tmp_path):
    sweep = replace(fitted.sweeps[0], path=Path(tmp_path, "gone.h5"))
    with pytest.raises(RunFileError, match="no such file"):
        write_report(ReedFit((sweep,), None, ""), tmp_path / "page.html")


@pytest.mark.parametrize(("joint", "expected"), [(True, [4279.0]), (False, [4308.6])])
def test_lines_that_a_joint_fit_found_outweigh_those_of_the_bench(joint, expected):
    peak = ExcitationPeak(4279.0, 3.0, 25.0, 1.0, 0.0, 0.0, 8.0, 0.3)
    sweep = SimpleNamespace(
        joint=object() if joint else None,
        excitation_peaks=(SeenPeak("R07", "run.h5", peak, None),),
    )
    assert list(_peaks_hz(sweep, SimpleNamespace(acoustic_resonances_hz=(4308.6,)))) == expected
