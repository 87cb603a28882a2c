"""The table of mutants stays applicable, and the runner tells a caught mutant from one that survives."""

from collections import Counter
from dataclasses import replace

import mutants
import pytest

TABLE = mutants.read_table()


def test_every_mutant_has_its_own_name_and_tests_that_exist():
    assert len(TABLE) >= 40
    assert max(Counter(mutant.name for mutant in TABLE).values()) == 1
    assert all((mutants.ROOT / test).is_file() for mutant in TABLE for test in mutant.tests)


@pytest.mark.parametrize("file", sorted({mutant.file for mutant in TABLE}))
def test_every_mutant_applies_once_and_changes_code_that_still_parses(file, tmp_path):
    path = tmp_path / "spnr_jax" / file
    path.parent.mkdir(parents=True)
    source = (mutants.ROOT / "spnr_jax" / file).read_text()
    for mutant in TABLE:
        if mutant.file == file:
            path.write_text(source)
            mutants.apply(mutant, tmp_path)
            assert path.read_text() != source
            compile(path.read_text(), mutant.name, "exec")


def test_a_mutant_that_applies_nowhere_is_an_error(tmp_path):
    (tmp_path / "spnr_jax").mkdir()
    (tmp_path / "spnr_jax" / "losses.py").write_text("x = 1\n")
    with pytest.raises(ValueError, match="occurs 0 times in losses.py"):
        mutants.apply(replace(TABLE[0], file="losses.py"), tmp_path)


@pytest.mark.slow
def test_a_broken_kernel_is_caught_and_a_harmless_change_survives():
    broken = next(mutant for mutant in TABLE if mutant.name == "l1 is l2")
    assert mutants.judge(broken)[1] == mutants.FAILED
    assert mutants.judge(replace(broken, new=broken.old + " * 1"))[1] == mutants.PASSED
