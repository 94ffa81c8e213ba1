import pytest

from redig.files import replacing


def test_failed_drawing_keeps_the_old_file(tmp_path):
    path = tmp_path / "figure.png"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as unfinished:
        assert unfinished.suffix == ".png"
        unfinished.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
