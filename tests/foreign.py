"""Sequences as public data sets lay them out, a few frames each, format-exact.

Every sequence is one lap of a wobbly loop of some 250 m. No reader opens an image, so those are
empty files with the right names.
"""

import numpy as np

START_S = 1_630_106_835
ORIGIN_M = (352_821.126572, 4_025_524.627789)  # the KAIST campus in UTM zone 52N
LAP_S = 60.0


def pose_at(t_s, left_m=0.0):
    """True pose at seconds since the start: UTM x and y, theta of the direction of travel."""
    angle = 2.0 * np.pi * np.asarray(t_s, float) / LAP_S
    r, dr = 40.0 * (1.0 + 0.2 * np.cos(3 * angle)), -24.0 * np.sin(3 * angle)
    c, s = np.cos(angle), np.sin(angle)
    theta = np.arctan2(dr * s + r * c, dr * c - r * s)
    x = ORIGIN_M[0] + r * c - left_m * np.sin(theta)
    y = ORIGIN_M[1] + r * s + left_m * np.cos(theta)
    return np.stack([x, y, theta], axis=-1)


def stamps(n, period_s, late_s=0.0):
    """Stamps since the start; `late_s` keeps cameras and poses off each other's."""
    return late_s + np.arange(n) * period_s


def write(path, rows, *, separator=",", header=None, dialect=""):
    """Write rows of text cells; a dialect is crlf, bom or trailing (blank lines)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [*([header] if header else []), *(separator.join(row) for row in rows)]
    text = "\n".join(lines) + ("\n\n\n" if dialect == "trailing" else "\n")
    text = text.replace("\n", "\r\n") if dialect == "crlf" else text
    text = "\ufeff" + text if dialect == "bom" else text
    path.write_bytes(text.encode())


def touch(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()


def ns(t_s):
    """Nanoseconds of UNIX time as text; whole numbers, for a float64 cannot hold them."""
    return str(START_S * 10**9 + round(float(t_s) * 1e9))


def us(t_s):
    return str(START_S * 10**6 + round(float(t_s) * 1e6))


def sthereo_rows(n=150, left_m=0.0):
    """Rows of pose/global_pose.csv at 2.5 Hz."""
    t_s = stamps(n, 0.4)
    return [
        [f"{START_S + t:.6f}", f"{x:.6f}", f"{y:.6f}", "44.574164", "0.5", "-1.2",
         f"{np.degrees(theta):.6f}"]
        for t, (x, y, theta) in zip(t_s, pose_at(t_s, left_m), strict=True)
    ]  # fmt: skip


def sthereo(folder, *, left_m=0.0, n=58, camera="stereo_thermal_14_left"):
    """Write a sequence of STheReO; the camera runs at 1 Hz."""
    names = [f"{ns(t)}.png" for t in stamps(n, 1.0, 0.13)]
    touch(folder / "image" / camera, names)
    write(folder / "pose/global_pose.csv", sthereo_rows(left_m=left_m))
    return folder


def sensors(folder, *, imu_columns=17):
    """Add the other sensors of STheReO to a sequence."""
    t_s = stamps(5, 0.1)
    zeros = ["0.0"] * 9
    data = folder / "sensor_data"
    kinds = ["gps", "inspva", "imu", "stereo", "stereo_thermal_14_left"]
    write(data / "data_stamp.csv", [[ns(t), k] for t, k in zip(t_s, kinds, strict=True)])
    write(data / "gps.csv", [[ns(t), "36.36357", "127.35950", "68.1", *zeros] for t in t_s])
    ins = ["36.36357", "127.35950", "68.1", "0.1", "4.2", "0.0", "0.5", "-1.2", "93.0"]
    write(data / "inspva.csv", [[ns(t), *ins, "INS_SOLUTION_GOOD"] for t in t_s])
    imu = ["0.0", "0.0", "0.7071", "0.7071", "0.0", "0.0", "1.57", *zeros]
    write(data / "xsens_imu.csv", [[ns(t), *imu][:imu_columns] for t in t_s])


def matrix_rows(n=600, left_m=0.0, turned=0.0):
    """Rows of MulRan's and Complex Urban's global_pose.csv at 10 Hz."""
    rows, t_s = [], stamps(n, 0.1)
    for t, (x, y, theta) in zip(t_s, pose_at(t_s, left_m), strict=True):
        c, s = np.cos(theta + turned), np.sin(theta + turned)
        values = (c, -s, 0.0, x, s, c, 0.0, y, 0.0, 0.0, 1.0, 44.5)
        rows.append([ns(t), *(f"{v:.9f}" for v in values)])
    return rows


def mulran(folder, *, left_m=0.0, turned=0.0, frames="sensor_data/Ouster", suffix=".bin"):
    """Write a sequence of MulRan, or of Complex Urban; without `frames` poses alone."""
    write(folder / "global_pose.csv", matrix_rows(left_m=left_m, turned=turned))
    if frames:
        touch(folder / frames, [f"{ns(t)}{suffix}" for t in stamps(58, 1.0, 0.13)])
    return folder


def wheels(folder):
    """Add wheel counters, gyro and calibration of Complex Urban to a sequence."""
    t_s = stamps(600, 0.1)
    poses = pose_at(t_s)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    theta = np.unwrap(poses[:, 2])
    base_m, per_m = 1.5, 4096 / (np.pi * 0.62)
    left = np.round((way - 0.5 * base_m * (theta - theta[0])) * per_m).astype(int)
    right = np.round((way + 0.5 * base_m * (theta - theta[0])) * per_m).astype(int)
    counts = zip(t_s, left, right, strict=True)
    write(folder / "sensor_data/encoder.csv", [[ns(t), str(a), str(b)] for t, a, b in counts])
    turns = zip(t_s, np.diff(theta, prepend=theta[0]), strict=True)
    write(folder / "sensor_data/fog.csv", [[ns(t), "0.0", "0.0", f"{d:.9f}"] for t, d in turns])
    lines = [
        "Encoder calibrated parameter",
        "Encoder resolution: 4096",
        "Encoder left wheel diameter: 0.62",
        "Encoder right wheel diameter: 0.62",
        f"Encoder wheel base: {base_m}",
    ]
    write(folder / "calibration/EncoderParameter.txt", [[line] for line in lines])


INS = (
    "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,"
    "velocity_north,velocity_east,velocity_down,roll,pitch,yaw"
)
RTK = INS.replace("ins_status,", "")
VO = "source_timestamp,destination_timestamp,x,y,z,roll,pitch,yaw"


def ins_rows(n=600, left_m=0.0):
    """Rows of gps/ins.csv at 10 Hz: north, east, down; yaw clockwise from north."""
    rows, t_s = [], stamps(n, 0.1)
    for t, (x, y, theta) in zip(t_s, pose_at(t_s, left_m), strict=True):
        yaw = np.angle(np.exp(1j * (np.pi / 2 - theta)))
        place = ["51.7604", "-1.2608", "112.1", f"{y:.6f}", f"{x:.6f}", "-112.1", "30U"]
        rows.append([us(t), "INS_SOLUTION_GOOD", *place, "0.1", "0.2", "0.0", "0.0", "0.0"])
        rows[-1].append(f"{yaw:.9f}")
    return rows


def robotcar(folder, *, left_m=0.0, vo=True, listed=True):
    """Write a traverse of Oxford RobotCar: gps/, vo/ and the list of its images."""
    rows = ins_rows(left_m=left_m)
    write(folder / "gps/ins.csv", rows, header=INS)
    frames = stamps(58, 1.0, 0.13)
    if listed:
        write(folder / "stereo.timestamps", [[us(t), "1"] for t in frames], separator=" ")
    if vo:
        # A row holds the motion up to its source stamp from its destination stamp.
        t_s = stamps(240, 0.25)
        poses = pose_at(t_s)
        steps = []
        for i in range(1, len(t_s)):
            dx, dy = poses[i, :2] - poses[i - 1, :2]
            c, s = np.cos(poses[i - 1, 2]), np.sin(poses[i - 1, 2])
            turn = np.angle(np.exp(1j * (poses[i, 2] - poses[i - 1, 2])))
            motion = (c * dx + s * dy, -(c * dy - s * dx), 0.0, 0.0, 0.0, -turn)
            steps.append([us(t_s[i]), us(t_s[i - 1]), *(f"{v:.9f}" for v in motion)])
        write(folder / "vo/vo.csv", steps, header=VO)
    return folder


def vivid(folder, *, left_m=0.0, shown=True, listed=False):
    """Write a driving sequence of ViViD++: positions at 5 Hz and images by their time."""
    t_s = stamps(300, 0.2)
    track = zip(t_s, pose_at(t_s, left_m), strict=True)
    rows = [[f"{x:.6f}", f"{y:.6f}", f"{START_S + t:.6f}"] for t, (x, y, _) in track]
    write(folder / "gpslist.txt", rows, separator=" ")
    frames = stamps(58, 1.0, 0.13)
    if shown:
        names = [f"{START_S + t:.6f}.png" for t in frames]
        touch(folder / "img/thermal_fieldscale_clahe", names)
    if listed:
        places = zip(frames, pose_at(frames, left_m), strict=True)
        rows = [[f"{x:.6f}", f"{y:.6f}", f"{START_S + t:.6f}"] for t, (x, y, _) in places]
        write(folder / "thermal_gps_framelist.txt", rows, separator=" ")
    return folder


def kri(folder, n):
    """Write a sequence of NUFR-KRI: images at 30 Hz and nothing else."""
    touch(folder / "cam_3/matlab_clahe2", [f"{ns(t)}.png" for t in stamps(n, 1 / 30)])
    return folder


def plain(folder, left_m=0.0, n=60, odometry=False):
    """Write a folder of one drive: poses.csv, and perhaps odometry.csv."""
    t_s = stamps(n, LAP_S / n)
    poses = pose_at(t_s, left_m) - np.array([*ORIGIN_M, 0.0])
    rows = [[f"{v:.6f}" for v in (t, *pose)] for t, pose in zip(t_s, poses, strict=True)]
    write(folder / "poses.csv", rows, header="t_s,x_m,y_m,theta_rad")
    if odometry:
        from conftest import motions

        steps = zip(t_s, motions(poses), strict=True)
        rows = [[f"{v:.6f}" for v in (t, *step)] for t, step in steps]
        write(folder / "odometry.csv", rows, header="t_s,dx_m,dy_m,dtheta_rad")
    return folder
