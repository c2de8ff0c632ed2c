from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings.recording import Recording

JOINTS = ("waist", "shoulder")
GOOD = "waist,shoulder,x,y,z\n0.1,0.2,1,2,3\n0.3,0.4,4,5,6\n"


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str | bytes, name: str = "measured.csv") -> Path:
        file = tmp_path / name
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return file

    return write


def fault(file: Path, joints: tuple[str, ...] = JOINTS) -> RecordingError:
    with pytest.raises(RecordingError) as caught:
        Recording.read(file, joints)
    assert str(file) in str(caught.value)
    return caught.value


def test_columns_are_found_by_name_in_any_order(write) -> None:
    recording = Recording.read(write("z,shoulder,x,waist,y\n3,0.2,1,0.1,2\n"), JOINTS)
    assert recording.q.tolist() == [[0.1, 0.2]]
    assert recording.x.tolist() == [[1.0, 2.0, 3.0]]


def test_all_known_columns_are_kept(write) -> None:
    recording = Recording.read(
        write(
            "t,segment,waist,shoulder,x,y,z,sx,sy,sz,ul,vl,ur,vr,qx,qy,qz,qw,current_waist,temperature_shoulder\n"
            "7.5,3,0.1,0.2,1,2,3,0.5,0.25,2,10,20,5,20,0,0,0,1,0.7,31\n"
        ),
        JOINTS,
    )
    assert recording.t is not None
    assert recording.t.tolist() == [7.5]
    assert recording.segment is not None
    assert recording.segment.tolist() == [3]
    assert recording.cov is not None
    assert recording.cov.tolist() == [[[0.25, 0, 0], [0, 0.0625, 0], [0, 0, 4]]]
    assert recording.centres_px is not None
    assert recording.centres_px.tolist() == [[10, 20, 5, 20]]
    assert recording.orientation is not None
    assert recording.orientation.tolist() == [[0, 0, 0, 1]]
    assert {name: column.tolist() for name, column in recording.extra.items()} == {
        "current_waist": [0.7],
        "temperature_shoulder": [31.0],
    }


def test_full_covariance_is_read_from_upper_triangle_columns(write) -> None:
    header = "waist,shoulder,x,y,z,cxx,cxy,cxz,cyy,cyz,czz\n"
    recording = Recording.read(write(header + "0,0,0,0,1,2,0.1,0.2,3,0.3,4\n"), JOINTS)
    assert recording.cov is not None
    assert recording.cov.tolist() == [[[2, 0.1, 0.2], [0.1, 3, 0.3], [0.2, 0.3, 4]]]


def test_byte_order_mark_and_crlf_are_accepted(write) -> None:
    text = "\ufeff" + GOOD.replace("\n", "\r\n")
    assert Recording.read(write(text), JOINTS).q.tolist() == [[0.1, 0.2], [0.3, 0.4]]


def test_arrays_of_a_recording_are_read_only(write) -> None:
    recording = Recording.read(write(GOOD), JOINTS)
    assert not recording.q.flags.writeable
    assert not recording.x.flags.writeable


@pytest.mark.parametrize(
    ("text", "line", "column", "says"),
    [
        ("", None, None, "empty"),
        ("waist,shoulder,x,y,z\n", None, None, "no rows"),
        ("waist,shoulder,x,y\n0,0,1,2\n", 1, "z", "no column"),
        ("waist,sholder,x,y,z\n0,0,1,2,3\n", 1, "shoulder", "'shoulder'"),
        ("waist,shoulder,x,y,z,tempo\n0,0,1,2,3,4\n", 1, "tempo", "unknown column"),
        ("waist,shoulder,x,y,z,x\n0,0,1,2,3,4\n", 1, "x", "two columns"),
        ("waist,shoulder,x,y,z,sx,sy\n0,0,1,2,3,4,5\n", 1, "sz", "without sz"),
        ("waist;shoulder;x;y;z\n0;0;1;2;3\n", None, None, "commas"),
        ("0.1,0.2,1,2,3\n0.3,0.4,4,5,6\n", None, None, "first line has numbers"),
        ("waist,shoulder,x,y,z\n0,0,1,2,3\n0,0,one,2,3\n", 3, "x", "'one' is not a number"),
        ("waist,shoulder,x,y,z\n0,0,1,2,3\n0,,1,2,3\n", 3, "shoulder", "empty"),
        ("waist,shoulder,x,y,z\n0,1_0,1,2,3\n", 2, "shoulder", "'1_0' is not a number"),
        ("waist,shoulder,x,y,z\n0,٣,1,2,3\n", 2, "shoulder", "is not a number"),
        ("waist,shoulder,x,y,z\n0,0,1,2,nan\n", 2, "z", "nan is not a finite number"),
        ("waist,shoulder,x,y,z\n0,0,1,2,3\n0,0,1,-inf,3\n", 3, "y", "-inf is not a finite number"),
        ("waist,shoulder,x,y,z\n0,0,1,1e999,3\n", 2, "y", "inf is not a finite number"),
        ("waist,shoulder,x,y,z\n0,0,1,2\n0,0,1,2,3\n", 2, "z", "4 fields where the header names 5"),
        ("waist,shoulder,x,y,z\n0,0,1,2,3,4\n", 2, None, "6 fields where the header names 5"),
        ("waist,shoulder,x,y,z\n0,0,1,2,3\n\n0,0,1,2,3\n", 3, None, "the line is empty"),
        ("waist,shoulder,x,y,z\n0,0,1,2,3\n0,0,1,", 3, None, "torn"),
        ("waist,shoulder,x,y,z\n0,0,1,2,3\n0,0,1,2,3", 3, "z", "no line end"),
        ("t,waist,shoulder,x,y,z\n1,0,0,1,2,3\n1,0,0,1,2,3\n", 3, "t", "does not come after"),
        ("t,segment,waist,shoulder,x,y,z\n2,1,0,0,1,2,3\n1,1,0,0,1,2,3\n", 3, "t", "does not come after"),
        ("segment,waist,shoulder,x,y,z\n1.5,0,0,1,2,3\n", 2, "segment", "not a whole number"),
        ("waist,shoulder,x,y,z,sx,sy,sz\n0,0,1,2,3,1,-1,1\n", 2, "sy", "has to be a positive length"),
        ("waist,shoulder,x,y,z,sx,sy,sz\n0,0,1,2,3,1,1,0\n", 2, "sz", "has to be a positive length"),
        ("waist,shoulder,x,y,z,cxx,cxy,cxz,cyy,cyz,czz\n0,0,1,2,3,1,2,0,1,0,1\n", 2, "cxx", "positive definite"),
        ("waist,shoulder,x,y,z,qx,qy,qz,qw\n0,0,1,2,3,0,0,0,2\n", 2, "qx", "length 2"),
        (GOOD.encode() + b"0,0,\xff,2,3\n", 4, None, "0xff is not UTF-8"),
        (GOOD.encode("utf-16"), None, None, "not UTF-8"),
    ],
)
def test_csv_error_states_line_and_column(write, text, line, column, says) -> None:
    error = fault(write(text))
    assert says in str(error)
    assert error.column == column
    if line is not None:
        assert error.line == line
        assert f"line {line}" in str(error)


def test_missing_joint_error_shows_the_misspelt_column(write) -> None:
    assert "sholder" in fault(write("waist,sholder,x,y,z\n0,0,1,2,3\n")).remedy


def test_an_unknown_column_gets_a_suggestion(write) -> None:
    error = fault(write("waist,shoulder,x,y,z,curent_waist\n0,0,1,2,3,4\n"))
    assert "Did you mean 'current_waist'?" in error.remedy


def test_time_may_start_again_in_a_new_segment(write) -> None:
    text = "t,segment,waist,shoulder,x,y,z\n5,1,0,0,1,2,3\n1,2,0,0,1,2,3\n"
    assert Recording.read(write(text), JOINTS).t.tolist() == [5.0, 1.0]  # pyright: ignore[reportOptionalMemberAccess]


def test_sigmas_beside_covariances_are_refused(write) -> None:
    header = "waist,shoulder,x,y,z,sx,sy,sz,cxx,cxy,cxz,cyy,cyz,czz\n"
    assert "both" in fault(write(header + "0,0,1,2,3,1,1,1,1,0,0,1,0,1\n")).what


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "there is no such file" in fault(tmp_path / "nowhere.csv").what


def test_a_folder_is_not_a_recording(tmp_path: Path) -> None:
    folder = tmp_path / "folder.csv"
    folder.mkdir()
    assert "folder" in fault(folder).what


def test_an_unknown_ending_is_refused(write) -> None:
    assert ".parquet" in fault(write(GOOD, "measured.txt")).what


@pytest.mark.parametrize("joint", ["x", "segment", "current_waist", "a,b", " a"])
def test_joint_name_unusable_as_column_is_rejected(write, joint: str) -> None:
    assert "Rename the joint" in fault(write(GOOD), ("waist", joint)).remedy


def test_a_recording_made_from_a_nan_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"row 2.*finite"):
        Recording(JOINTS, np.zeros((2, 2)), np.array([[0, 0, 0], [0, 0, np.nan]]))


def test_recording_rejects_arrays_of_unequal_length() -> None:
    with pytest.raises(ValueError, match="x has the shape"):
        Recording(JOINTS, np.zeros((2, 2)), np.zeros((3, 3)))


def test_chosen_rows_keep_all_their_columns(write) -> None:
    text = "t,segment,waist,shoulder,x,y,z,sx,sy,sz,current_waist\n"
    text += "".join(f"{i},1,{i},0,0,0,{i},1,1,1,{i * 10}\n" for i in range(5))
    chosen = Recording.read(write(text), JOINTS).rows(np.array([False, True, False, True, True]))
    assert chosen.q[:, 0].tolist() == [1, 3, 4]
    assert chosen.extra["current_waist"].tolist() == [10, 30, 40]
    assert chosen.cov is not None
    assert len(chosen.cov) == 3


def test_a_position_that_no_arm_reaches_is_refused(tmp_path) -> None:
    (tmp_path / "a.csv").write_text("lift,x,y,z\n0,1,2,3\n0,1,-1e200,3\n")
    with pytest.raises(RecordingError, match=r"line 3, column y: -1e\+200 is no position in metres"):
        Recording.read(tmp_path / "a.csv", ("lift",))
