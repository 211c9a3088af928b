"""Flags of `taojax convert`, one class per data set."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from taojax.cli.common import flag

Kind = Literal[
    "tum", "kitti", "euroc", "g2o", "csv", "steps", "poses", "wheels", "bag", "robotcar-vo"
]


def _place(metavar: str) -> Any:
    return tyro.conf.arg(metavar=metavar)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Formats:
    """How files of poses and odometry are read."""

    gate_s: float = 0.5
    """A pose or odometry farther than this from a frame in time is none, seconds."""

    odometry_kind: Annotated[Kind | None, flag("KIND", "as its header or columns say")] = None
    """Its format: tum, kitti, euroc, g2o, csv (stamped poses), steps (as query/odometry.csv),
    wheels (a Complex Urban folder), bag or robotcar-vo. Of an .npy, which cannot say it: steps
    (forward, left, yaw since the row before) or poses (x, y, theta), with or without stamps."""

    times: Annotated[Path | None, flag("FILE", "none")] = None
    """Stamps of odometry without any (kitti, g2o, arrays)."""

    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, flag("UNIT", "recognised")] = None
    """Unit of stamps, in every file that they can be of this unit in."""

    clock_offset: Annotated[float | None, flag("S", "found where counts and steps agree")] = None
    """Seconds to add to the stamps of the odometry."""

    quaternion: Annotated[
        Literal["xyzw", "wxyz"] | None, flag("xyzw|wxyz", "as the kind has it")
    ] = None
    """Order of quaternions, in every file whose direction of motion does not exclude it."""

    angles: Annotated[Literal["rad", "deg", "compass"] | None, flag("UNIT", "as names say")] = None
    """Headings: rad or deg counter-clockwise from x; compass: degrees clockwise from y, north."""

    columns: Annotated[str | None, flag("NAMES", "as the header says")] = None
    """Names of the columns of text without a header, such as t,x,y,theta; - is not used."""

    decimal: Annotated[Literal["point", "comma"] | None, flag("point|comma", "recognised")] = None
    """Decimal sign of text."""

    plane: Annotated[Literal["xz", "xy", "xz-up"] | None, flag("PLANE", "as the kind has it")] = (
        None
    )
    """Axes of the ground in 3-D poses: xz for cameras (y down; xz-up: y up), xy where z is up."""

    topic: Annotated[str | None, flag("NAME", "the only one")] = None
    """Odometry topic of a bag."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Making(Formats):
    """Flags of every data set."""

    map_frames: Annotated[int | None, flag("N", "2000; of folder and files, all")] = None
    """Map frames to keep, evenly by number."""

    query_frames: Annotated[int | None, flag("N", "1000; of folder and files, all")] = None
    """Query frames to keep, evenly by number."""

    spacing_m: Annotated[float | None, flag("M", "by number")] = None
    """Keep a frame every so many metres of way instead; standing frames then count once."""

    pose: Literal["interpolated", "nearest"] = "interpolated"
    """Whether a frame lies between the poses around it or at the nearest."""

    least_matched: float = 0.5
    """Refuse a session where a smaller share of the frames has a pose."""

    odometry: Annotated[Path | None, flag("FILE", "the set's own, else simulated")] = None
    """Odometry of the query session."""

    descriptors_order: Annotated[Literal["rows", "time"] | None, flag("rows|time", "asked")] = None
    """What descriptors follow where rows of poses came late: the rows of that file, or time."""

    map_descriptors: Annotated[Path | None, flag("FILE", "none")] = None
    """Descriptors of the map images (npy, npz, h5); or, without --query-descriptors, one file that
    answers for both: retrieval lists (npz, csv), a similarity matrix (npy), an hloc h5."""

    query_descriptors: Annotated[Path | None, flag("FILE", "none")] = None
    """Descriptors of the query images."""

    simulate_descriptors: bool = False
    """Simulate the descriptors of both sessions from their poses; the report says so."""

    seed: int = 0
    """Of everything that is simulated."""


@dataclasses.dataclass(frozen=True)
class Pair(Making):
    """Two recorded sequences and the data folder they become."""

    map: Annotated[Path, tyro.conf.Positional, _place("MAP")]
    """Sequence that becomes the map."""

    query: Annotated[Path, tyro.conf.Positional, _place("QUERY")]
    """Sequence that asks where it is."""

    out: Annotated[Path, tyro.conf.Positional, _place("OUT")]
    """Data folder to make."""


@dataclasses.dataclass(frozen=True)
class Sthereo(Pair):
    """STheReO: two folders with image/ and pose/, or two frame lists.

    Example: taojax convert sthereo kaist_morning kaist_evening OUT --simulate-descriptors
    """

    camera: str = "stereo_thermal_14_left"
    """Folder below image/ whose files are the frames."""

    poses: Literal["global", "local"] = "global"
    """pose/global_pose.csv in UTM, or pose/local_pose.csv."""


@dataclasses.dataclass(frozen=True)
class Kri(Pair):
    """NUFR-KRI: image sequences without poses; the position is the progress along the route.

    Example: taojax convert kri kri_day_2 kri_night OUT --map-descriptors day.npy
    --query-descriptors night.npy
    """

    camera: str = "cam_3"
    """Folder of the camera."""

    variant: str = "matlab_clahe2"
    """Folder of the prepared images below it."""

    route_m: Annotated[float | None, flag("M", "the unit is a row of the map")] = None
    """Length of the route, metres."""


@dataclasses.dataclass(frozen=True)
class Mulran(Pair):
    """MulRan: two folders with global_pose.csv.

    Example: taojax convert mulran KAIST01 KAIST02 OUT --simulate-descriptors
    """

    frames: Annotated[str | None, flag("SUBFOLDER", "lidar, radar or the poses themselves")] = None
    """Folder whose files, named by their stamp, are the frames."""


@dataclasses.dataclass(frozen=True)
class ComplexUrban(Pair):
    """KAIST Complex Urban: two folders with global_pose.csv; wheels and gyro are the odometry.

    Example: taojax convert complex-urban urban28 urban38 OUT --simulate-descriptors
    """

    frames: Annotated[str | None, flag("SUBFOLDER", "left camera or the poses themselves")] = None
    """Folder whose files, named by their stamp, are the frames."""


@dataclasses.dataclass(frozen=True)
class Robotcar(Pair):
    """Oxford RobotCar: two traverses with gps/; vo/vo.csv is the odometry.

    Example: taojax convert robotcar 2014-07-14-14-49-50 2015-05-19-14-06-38 OUT
    --simulate-descriptors
    """

    camera: str = "stereo/centre"
    """Folder of the images; or its list stereo.timestamps."""

    gps: Literal["ins", "rtk"] = "ins"
    """gps/ins.csv or gps/rtk.csv."""


@dataclasses.dataclass(frozen=True)
class Vivid(Pair):
    """ViViD++: two driving sequences with gpslist.txt or thermal_gps_framelist.txt.

    Example: taojax convert vivid campus_day1 campus_night OUT --simulate-descriptors
    """

    frames: str = "img/thermal_fieldscale_clahe"
    """Folder whose files, named by their time in seconds, are the frames."""


@dataclasses.dataclass(frozen=True)
class Folder(Making):
    """A folder of your own; or, with --map, two folders of one drive each.

    Example: taojax convert folder my_recording OUT --map-descriptors map.npy
    --query-descriptors query.npy
    """

    folder: Annotated[Path, tyro.conf.Positional, _place("FOLDER")]
    """Folder with map/poses.csv and query/poses.csv, truth/query_poses.csv or query/odometry.csv;
    with --map, of the query drive: poses.csv and, where it is known, odometry.csv."""

    out: Annotated[Path, tyro.conf.Positional, _place("OUT")]
    """Data folder to make."""

    map: Annotated[Path | None, flag("FOLDER", "FOLDER holds both")] = None
    """Folder of the map drive: poses.csv."""


@dataclasses.dataclass(frozen=True)
class Files(Making):
    """Single files of any name: .npy, csv, TUM, KITTI, EuRoC or g2o.

    Example: taojax convert files OUT --map-poses places.npy --odometry moves.npy --odometry-kind
    steps --query-poses slam.txt --map-descriptors a.npy --query-descriptors b.npy
    """

    out: Annotated[Path, tyro.conf.Positional, _place("OUT")]
    """Data folder to make; or one with a map, to which query or truth are added."""

    map_poses: Annotated[Path | None, flag("FILE", "those in OUT")] = None
    """Poses of the map images: an .npy of (M, 3) x, y, theta or (M, 4) with the stamp first, a
    table with names such as t,x,y,theta, or what another program wrote."""

    query_poses: Annotated[Path | None, flag("FILE", "nobody knows them: no audit")] = None
    """True poses of the query images, one each, in the same kinds of files; where OUT holds a query
    already, any that cover its time."""


@dataclasses.dataclass(frozen=True)
class Self:
    """One drive that closes on itself: a frame's map is what lies so much way behind it.

    Example: taojax convert self my_drive OUT --gap-m 50
    """

    folder: Annotated[Path, tyro.conf.Positional, _place("FOLDER")]
    """Data folder of one drive: query/ and, to audit, truth/. With map/ too, the query's drive
    follows the map's."""

    out: Annotated[Path, tyro.conf.Positional, _place("OUT")]
    """Data folder to make."""

    gap_m: Annotated[float | None, flag("M", "50")] = None
    """Way between a frame and the newest that it may close on, metres; in buildings 10 to 20."""

    seed: int = 0
    """Of odometry that is simulated where two drives are joined."""


@dataclasses.dataclass(frozen=True)
class Convert:
    """Make a data folder of a public data set or of your own recordings.

    Example: taojax convert sthereo kaist_morning kaist_evening OUT --simulate-descriptors
    """

    data: Annotated[
        Sthereo | Kri | Mulran | ComplexUrban | Robotcar | Vivid | Folder | Files | Self,
        tyro.conf.OmitSubcommandPrefixes,
        tyro.conf.OmitArgPrefixes,
    ]
