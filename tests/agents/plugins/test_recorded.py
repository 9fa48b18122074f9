"""Trajectories of files: each format is read to the numbers that it holds, or refused with line and remedy."""

from base64 import b64encode
from math import cos, isnan, nan, pi, radians, sin

import pytest

from agents.plugins.recorded.formats import FormatError, read
from agents.plugins.recorded.planner import Recorded

HEADER = "duration," + ",".join(f"{axis}^{power}" for axis in ("x", "y", "z", "yaw") for power in range(8))
VICON = """Objects
100
,,Global Angle drone:drone,,,,,,Global Angle wand:wand,,,,,
Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,RY,RZ,TX,TY,TZ
,,deg,deg,deg,mm,mm,mm,deg,deg,deg,mm,mm,mm
11,0,0,0,90,100,200,300,0,0,0,1000,0,0
12,0,,,,,,,0,0,0,1000,0,0
13,0,0,0,91,120,200,300,0,0,0,1000,0,0

Devices
1000
"""


MOTIVE = """Format Version,1.23,Take Name,Take 1,Rotation Type,Quaternion,Length Units,Millimeters

,,"Rigid Body",Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Marker,Rigid Body
,Name,cf 1,cf 1,cf 1,cf 1,cf 1,cf 1,cf 1,cf 1,"cf 1:Marker1",wand
,ID,"A","A","A","A","A","A","A","A","0","B"
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,X
0,0.000000,0,0.707107,0,0.707107,100,300,-200,0.1,1,5
1,0.100000,,,,,,,,,,5
2,0.200000,0,0,0,1,200,300,-200,0.1,1,5
"""
NAMES = [f"/CF0{n}/pose/position/{axis}" for n in (1, 2) for axis in "xy"]
RUN = "case,time,robot,x,y,yaw\na,0,R1,0,0,0\na,0,R2,1,0,0\nb,1,R1,1,0,0\nb,1,R2,2,0,0\n"
TOPICS = f"time,{','.join(NAMES)}\n0,0,1,5,6\n1,1,1,6,6\n"  # columns as PlotJuggler names them


QTM = """NO_OF_FRAMES	3
FREQUENCY	100
DATA_INCLUDED	6D
BODY_NAMES	drone	wand
Frame	Time	drone X	Y	Z	Roll	Pitch	Yaw	Residual	wand X	Y	Z	Roll	Pitch	Yaw	Residual
1	0.00000	100.0	200.0	300.0	0	0	90.0	0.5	1	1	1	0	0	0	0.5
2	0.01000	0.000	0.000	0.000	0	0	0.0	-1	1	1	1	0	0	0	0.5
3	0.02000	110.0	200.0	300.0	0	0	91.0	0.5	NULL	NULL	NULL	0	0	0	0.5
"""


def piece(duration, **axes):
    """Line of a piece; of each axis its first coefficients."""
    values = [each for name in ("x", "y", "z", "yaw") for each in (*axes.get(name, ()), *[0] * 8)[:8]]
    return ",".join(map(str, [duration, *values]))


def content(text):
    return b64encode(text.encode()).decode()


@pytest.mark.parametrize(
    ("text", "body", "poses"),
    [
        ("t,x,y,z,yaw\n5,0,0,0.5,0\n6,1,2,0.7,1\n", "",
         {0.0: (0, 0, 0.5, 0), 0.5: (0.5, 1, 0.6, 0.5), 9.0: (1, 2, 0.7, 1)}),
        ("# t x y\n0 0 0\n2 1 1\n", "", {1.0: (0.5, 0.5, nan, nan)}),
        ("Time (ms);X [mm];Y [mm];Yaw [deg]\n0;0;0;170\n1000;500;0,5;-170\n", "", {0.5: (0.25, 0.00025, nan, pi)}),
        ("%time,field.header.seq,field.pose.position.x,field.pose.position.y\n1700000000000000000,1,0,0\n"
         "1700000002000000000,2,1,0\n", "", {1.0: (0.5, 0, nan, nan)}),
        ("time_s,CF01_x_m,CF01_y_m,CF02_x_m,CF02_y_m\n0,0,0,5,5\n1,1,1,6,6\n", "CF02", {0.5: (5.5, 5.5, nan, nan)}),
        ("# timestamp tx ty tz qx qy qz qw\n1e9 0 0 1 0 0 0 1\n1000000001.0 1 0 1 0 0 1 0\n", "",
         {0.0: (0, 0, 1, 0), 1.0: (1, 0, 1, pi)}),
        ("# recorded\n# timestamp tx ty tz qw qx qy qz\n0 0 0 1 0 0 0 1\n1 1 0 1 1 0 0 0\n", "",
         {0.0: (0, 0, 1, pi), 1.0: (1, 0, 1, 0)}),
        ("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],b_w_x\n"
         "1403636580838555648,0,0,1,0,0,0,1,9\n1403636581838555648,1,0,1,1,0,0,0,9\n", "",
         {0.0: (0, 0, 1, pi), 1.0: (1, 0, 1, 0)}),
        (TOPICS, "CF02", {0.5: (5.5, 6, nan, nan)}),
        (TOPICS, "/CF01/pose", {0.5: (0.5, 1, nan, nan)}),
        ("t,x,y,CF01_x,CF01_y\n0,0,0,5,5\n1,0,0,6,6\n", "CF01", {0.5: (5.5, 5.5, nan, nan)}),
        (RUN.replace("b,1", "a,1"), "R2", {0.5: (1.5, 0, nan, 0)}),
        ("t,x,y\n0,0,0\n1,1,1\n", "CF01", {0.5: (0.5, 0.5, nan, nan)}),
        (VICON, "drone", {0.0: (0.1, 0.2, 0.3, radians(90)), 0.01: (0.11, 0.2, 0.3, radians(90.5))}),
        (QTM, "drone", {0.0: (0.1, 0.2, 0.3, radians(90)), 0.01: (0.105, 0.2, 0.3, radians(90.5))}),
        (MOTIVE, "cf 1", {0.0: (0.1, 0.2, 0.3, radians(90)), 0.1: (0.15, 0.2, 0.3, radians(45))}),
        (f"{HEADER}\n{piece(2, x=(0, 1), yaw=(0.5,))}\n{piece(1, x=(2, 1, -0.5), y=(0, 0, 0, 1), yaw=(0.5,))}\n", "",
         {1.0: (1, 0, 0, 0.5), 2.5: (2.375, 0.125, 0, 0.5), 9.0: (2.5, 1, 0, 0.5)}),
    ],
)  # fmt: skip
def test_formats_hold_these_poses(text, body, poses):
    curve = read(text, body)
    for time, pose in poses.items():
        assert curve.pose(time) == pytest.approx(pose, abs=1e-6, nan_ok=True)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no numbers; a CSV begins with names"),
        ("1,2,3\n", "line 1: 3 numbers without names"),
        ("t,y\n0,0\n", "line 1: no column x; name the columns"),
        ("t,x,y\n0,0,0\n", "fewer than two poses"),
        ("t,x,y\n0,0,0\n1,here,0\n", "line 3: 'here' in column 2 is no number; mend it"),
        ("t,x,y\n0,0,0\n1,nan,0\n", "line 3: 'nan' in column 2 is no place"),
        ("t,x,y\n0,0,0\n1,1\n", "line 3: column 3 is empty"),
        ("t,x,y\n0,0,0\n1,0,0\n1,0,0\n", "line 4: its time 1 s is not after that of line 3; sort"),
        (f"{HEADER}\n1,2,3\n", "line 2: 3 numbers; a piece is a duration and 32"),
        (f"{HEADER}\n{piece(0)}\n", "line 2: the duration 0 s; give a positive one"),
        (f"{HEADER}\n", "no piece"),
        (RUN, 'line 1: it has the robots R1, R2; write body = "R1", or another'),
        (RUN.replace("R2", "R1"), 'line 1: it has the cases a, b; keep the lines of "a", or of another'),
        (TOPICS, 'line 1: it has places of CF01_pose, CF02_pose; write body = "CF01_pose", or another'),
        (VICON, 'line 3: it has drone, wand; write body = "drone"'),
        (VICON.replace("100\n", "\n", 1), "no rate stands above"),
        (VICON.replace("TX", "MX"), "line 4: no columns TX"),
        (QTM, 'line 5: it has drone, wand; write body = "drone"'),
        (QTM.replace(" X", " E"), "line 5: no column ends with X; export 6D data from QTM"),
        (MOTIVE, 'line 4: it has cf 1, wand; write body = "cf 1"'),
        (MOTIVE.replace("Length Units", "Scale"), "line 1: no Length Units; export from Motive in meters"),
        (MOTIVE.replace("Rigid Body", "Marker"), "line 7: no rigid body; export from Motive with Rigid Bodies"),
        (MOTIVE.replace("cf 1", "drone").replace("Position", "Place"), "line 7: no Position X, Y, Z of drone"),
        (VICON.replace("13,0", "93,0"), "line 8: drone was hidden for 0.82 s; record again"),
    ],
)
def test_other_texts_are_refused_with_their_line(text, said):
    with pytest.raises(FormatError) as raised:
        read(text, "drone" if "drone" in text and "it has" not in said else "")
    assert said in str(raised.value)


LINE = "t,x,y,z\n0,1,0,0.5\n2,1.6,0,0.5\n4,1.6,0.2,0.9\n"
PLANNER = Recorded(file="line.csv", content=content(LINE))


def test_part_of_a_file_is_followed():
    assert PLANNER.target(1.0, (9.0, 9.0, 9.0), 0.0)[:3] == pytest.approx((1.3, 0.0, 0.5))
    assert isnan(PLANNER.target(1.0, (9.0, 9.0, 9.0), 0.0)[3])
    assert (PLANNER.duration, PLANNER.speed()) == pytest.approx((4.0, 0.3))
    assert PLANNER.source(2.5) == "line.csv, line 3"
    part = Recorded(file="line.csv", relative=True, stretch=2.0, from_s=1.0, until_s=3.0, content=PLANNER.content)
    assert part.target(0.0, (0.0, 0.0, 0.6), 0.0)[:3] == pytest.approx((0.0, 0.0, 0.6))
    assert part.target(99.0, (0.0, 0.0, 0.6), 0.0)[:3] == pytest.approx((0.3, 0.1, 0.8))
    assert (part.duration, part.speed()) == pytest.approx((4.0, 0.15))


def test_speed_of_a_polynomial_is_its_largest():
    circle = piece(1.0, x=(0, 1, 0, -1 / 6), y=(1, 0, -0.5))  # sine and cosine, nearly
    planner = Recorded(file="circle.csv", content=content(f"{HEADER}\n{circle}\n"))
    assert planner.speed() == pytest.approx(max((1 - 0.5 * t * t) ** 2 + t * t for t in (0.0, 1.0)) ** 0.5, rel=2e-3)
    x, y, *_ = planner.target(0.5, (0.0, 0.0, 0.0), 0.0)
    assert (x, y) == pytest.approx((sin(0.5), cos(0.5)), abs=3e-3)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"from_s": 4.0, "content": content(LINE)}, "nothing of a.csv lies between"),
        ({"content": content(f"{HEADER}\n{piece(1)}\n{piece(1, x=(0.5,))}\n")}, "line 3: it begins 0.5 m from the end"),
        ({"content": content("1,2\n")}, "a.csv, line 1: 2 numbers"),
    ],
)
def test_wrong_parameters_are_refused(parameters, said):
    with pytest.raises(ValueError, match=said):
        Recorded(file="a.csv", **parameters)
