"""Every ablation still applies to the four files, and takes its piece out of one of them."""

from pathlib import Path

import pytest

from extras.ablate import DIFFS, FILES, ROOT, copy


@pytest.mark.parametrize("name", DIFFS)
def test_each_diff_applies_to_the_code_as_it_is_and_changes_one_file(
    name: str, tmp_path: Path
) -> None:
    folder = copy(name, tmp_path / "copy")
    changed = [f for f in FILES if (folder / f).read_text() != (ROOT / f).read_text()]
    assert len(changed) == 1
    compile((folder / changed[0]).read_text(), changed[0], "exec")
