"""Brief notes about kernels' sources: the same kernels, errors that still tell where, and other Taichis left alone."""

import textwrap
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernels.test_runtime import run
from tk.kernels import source_notes
from tk.kernels.runtime import ensure_runtime, ti


@ti.kernel
def _faulty() -> ti.i32:
    return undefined_name  # noqa: F821


def test_an_error_names_file_line_and_code(monkeypatch):
    ensure_runtime()
    monkeypatch.setattr(source_notes, "_OURS", "tests.")
    with pytest.raises(ti.TaichiNameError) as caught:
        _faulty()
    told = str(caught.value)
    assert __file__ in told and "in _faulty:" in told and "return undefined_name" in told and "^" not in told


def test_kernels_of_others_keep_their_notes():
    ensure_runtime()
    with pytest.raises(ti.TaichiNameError) as caught:
        _faulty()
    assert "^" in str(caught.value)


@settings(deadline=None, max_examples=200)
@given(line=st.text(st.sampled_from(" \t\n\x0bab#é"), max_size=30))
def test_lines_are_as_taichi_has_them(line):
    assert source_notes._fill(line, tabsize=4, width=9999) == textwrap.fill(line, tabsize=4, width=9999)


def test_a_line_too_long_is_left_to_textwrap():
    assert source_notes._fill("ab cd", width=3) == "ab\ncd"


@pytest.mark.parametrize(
    "utilities, kernels",
    [
        (SimpleNamespace(), SimpleNamespace(textwrap=textwrap)),
        (SimpleNamespace(ASTTransformerContext=SimpleNamespace()), SimpleNamespace(textwrap=textwrap)),
        (SimpleNamespace(ASTTransformerContext=SimpleNamespace(get_pos_info=len)), SimpleNamespace()),
    ],
    ids=["no context", "no notes", "no sources"],
)
def test_another_taichi_is_left_as_it_is(utilities, kernels):
    before = repr(utilities), repr(kernels)
    assert not source_notes.brief(utilities, kernels)
    assert before == (repr(utilities), repr(kernels))


def test_a_context_of_another_kind_gets_the_full_note():
    context = type("Context", (), {"get_pos_info": lambda self, node: "full"})
    assert (
        source_notes.brief(
            SimpleNamespace(ASTTransformerContext=context), SimpleNamespace(textwrap=None, getsourcelines=None)
        )
        is False
    )
    assert source_notes.brief(SimpleNamespace(ASTTransformerContext=context), SimpleNamespace(textwrap=textwrap))
    assert context().get_pos_info(None) == "full"


def test_a_callers_own_runtime_keeps_its_notes():
    printed = run(
        """
        from tk.kernels.runtime import ensure_runtime, ti
        ti.init(arch=ti.cpu, log_level=ti.ERROR)
        ensure_runtime()
        from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
        print(hasattr(ASTTransformerContext.get_pos_info, "__wrapped__"))
        """
    )
    assert printed[-1] == "False"
