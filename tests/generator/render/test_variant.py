"""Laws of the choice of Mitsuba's variant: it never ends the program, and it prefers the newest library."""

import os

import pytest

from data_gen.render import variant


@pytest.fixture
def libraries(tmp_path, monkeypatch):
    """A made-up system with these LLVM libraries and nothing else."""
    (tmp_path / "lib" / "somewhere").mkdir(parents=True)
    for name in ("libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-17.so", "libLLVMX86Desc.a", "libLLVM-14.0.6.so.1"):
        (tmp_path / "lib" / "somewhere" / name).touch()
    monkeypatch.setattr(variant, "LIBRARY_ROOTS", (str(tmp_path),))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "")
    return tmp_path / "lib" / "somewhere"


def test_only_libraries_that_can_work_are_tried_newest_first(libraries, monkeypatch):
    assert [path.name for path in variant.llvm_libraries()] == ["libLLVM.so.19.1", "libLLVM-17.so"]
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/named/libLLVM.so")
    assert [str(path) for path in variant.llvm_libraries()] == ["/named/libLLVM.so"]


def test_a_library_that_works_is_used_and_passed_on_to_child_processes(libraries, monkeypatch):
    monkeypatch.setattr(variant, "probe", lambda library: "17" in library.name)
    assert variant.choose_variant() == ("llvm_ad_rgb", None)
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(libraries / "libLLVM-17.so")


def test_a_library_that_kills_the_probing_process_leads_to_scalar_code_and_a_notice(libraries, monkeypatch):
    monkeypatch.setattr(variant, "PROBE", "import os; os.abort()")
    name, notice = variant.choose_variant()
    assert name == "scalar_rgb"
    assert "install LLVM" in notice
    assert "\n" not in notice
    with pytest.raises(ValueError, match="does not run here"):
        variant.choose_variant("llvm_ad_rgb")
