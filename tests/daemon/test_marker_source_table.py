"""The table [marker_source]: what it may say, and how the commands show it."""

from __future__ import annotations

import numpy as np
import pytest
from small_arm import write_small_arm

from bodyschema.cli.install.units import devices_of, endpoints_of
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.cameras import camera_lines
from bodyschema.daemon.wiring.wiring import marker_source_lines, open_sources
from bodyschema.drivers.markers.config import NatnetTable, UdpTable
from bodyschema.drivers.markers.fusing import FusedMarkers
from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rig_file import write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationProvenance, StereoRig

JOINTS = '[drivers.ros2]\nrouter = "tcp/127.0.0.1:7461"\n'


def load(folder, text: str) -> Config:
    return Config.load(write_small_arm(folder, text))


def test_one_source_is_a_table(tmp_path) -> None:
    config = load(tmp_path, '[marker_source]\nkind = "udp"\nport = 5010\n')
    assert config.tables.marker_source == (UdpTable(port=5010),)


def test_several_sources_are_an_array_of_tables(tmp_path) -> None:
    text = '[[marker_source]]\nkind = "udp"\n[[marker_source]]\nkind = "natnet"\nbody = 3\nxyz = [1.0, 0.0, 0.0]\n'
    config = load(tmp_path, text)
    assert config.tables.marker_source == (UdpTable(), NatnetTable(body=3, xyz=(1.0, 0.0, 0.0)))
    lines = list(marker_source_lines(config))
    assert lines[0] == "marker positions by udp (udp) at udp/127.0.0.1:5005, in m"
    assert "body 3" in lines[2]


ONE, TWO = "[marker_source]\n", "[[marker_source]]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{ONE}port = 1\n", "line 8: the kind is missing in [marker_source]"),
        (f'{ONE}kind = "upd"\n', "line 9: marker_source.kind: 'upd' is unknown. Did you mean 'udp'?"),
        (f'{ONE}kind = "udp"\nprot = 1\n', "line 10: unknown key 'prot' in [marker_source]. Did you mean 'port'?"),
        (f'{ONE}kind = "udp"\nport = 0\n', "line 10: marker_source.port: "),
        (f'{ONE}kind = "udp"\nhost = "lab"\n', "line 10: marker_source.host: 'lab' is no IPv4 address"),
        (f'{ONE}kind = "zenoh"\nkey = "a/**"\n', "is no zenoh key without wild cards"),
        (f'{ONE}kind = "zenoh"\n', "Write in [zenoh]: sampler = "),
        (f'{ONE}kind = "ros2"\nmessage = "tf"\n', "TF has many transforms. Name the marker's frame as child"),
        (f'{TWO}kind = "udp"\n{TWO}kind = "udp"\nport = 6\n', "two marker sources have the name 'udp'"),
        (f'{TWO}kind = "udp"\n{TWO}kind = "natnet"\nunit = "cm"\n', "line 12: marker_source.unit: 'cm' is unknown"),
    ],
)
def test_wrong_keys_are_named_with_line_and_remedy(tmp_path, text, said) -> None:
    with pytest.raises(ConfigError) as error:
        load(tmp_path, text)
    assert said in str(error.value)


def test_arm_with_a_marker_source_needs_no_cameras(tmp_path) -> None:
    config = load(tmp_path, f'{JOINTS}[marker_source]\nkind = "udp"\n')
    with open_sources(config, sim=False) as sources:
        assert sources.calibration is None
        assert sources.marker_source_name == "the positions by udp"


CAMERAS = """
focal_px = 600.0
principal_point_px = [319.5, 239.5]
baseline_m = 0.1
image_size_px = [640, 480]
[vision.cameras.two]
left = "/dev/v4l/by-id/a"
right = "/dev/v4l/by-id/b"
image_size_px = [640, 480]
[[vision.further_cameras]]
name = "side"
xyz = [1.0, 0.0, 0.5]
{calibration}
[vision.further_cameras.two]
left = "/dev/v4l/by-id/c"
right = "/dev/v4l/by-id/d"
image_size_px = [640, 480]
"""


def test_further_cameras_and_mocap_are_fused(tmp_path) -> None:
    lens = Lens("pinhole", (600.0, 600.0), (319.5, 239.5), (0.0,) * 5)
    made = CalibrationProvenance("2026-01-01T00:00:00Z", "none", 1, 0, 0.1, 0.1, 0.0)
    place = np.array([-0.1, 0.0, 0.0])
    write_rig(
        StereoRig(lens, lens, np.zeros(3), place, (640, 480), ("C", "D"), np.eye(24), made), tmp_path / "side.toml"
    )
    text = CAMERAS.format(calibration='calibration = "side.toml"') + JOINTS + f'{TWO}kind = "udp"\n'
    config = load(tmp_path, text)
    with open_sources(config, sim=False) as sources:
        assert sources.marker_source_name == "the positions by cameras and side and udp"
        assert isinstance(sources.marker, FusedMarkers)
        assert [member.name for member in sources.marker.members] == ["cameras", "side", "udp"]
        np.testing.assert_allclose(sources.marker.members[1].pose[:3, 3], [1.0, 0.0, 0.5])
    assert "side: calibrated by side.toml: pinhole lenses, baseline 100.0 mm" in list(camera_lines(config))
    assert "/dev/v4l/by-id/c" in devices_of(config)


def test_further_cameras_need_a_calibration(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"vision\.further_cameras: nothing says how they see"):
        load(tmp_path, CAMERAS.format(calibration=""))


def test_service_is_granted_the_network_of_the_source(tmp_path) -> None:
    config = load(tmp_path, '[marker_source]\nkind = "natnet"\nserver = "192.168.1.20"\n')
    assert "udp/192.168.1.20:1510" in endpoints_of(config)
