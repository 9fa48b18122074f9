#!/usr/bin/env bash
# OpenCV 5.0.0, pupil-apriltags 1.0.4: a marker that OpenCV makes of its dictionary DICT_APRILTAG_36h11 is read by the
# AprilTag library with the same number and no wrong bit, and turned by 180 degrees. Guess: one family, one picture.
# A lab that prints with one and reads with the other gets every yaw wrong by half a turn; 25h9 and 16h5 are the same.
# Seen: the tag's x axis, which both let run along its lower edge, goes to the right for OpenCV, to the left for AprilTag
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet opencv-python-headless==5.0.0.93 pupil-apriltags==1.0.4.post11 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import cv2
import numpy as np
from pupil_apriltags import Detector

camera = np.array([[400.0, 0.0, 200.0], [0.0, 400.0, 200.0], [0.0, 0.0, 1.0]])
square = np.array([[-0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [0.1, -0.1, 0.0], [-0.1, -0.1, 0.0]])
for family in ("36h11", "25h9", "16h5"):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{family}"))
    image = np.full((400, 400), 255, np.uint8)
    image[100:300, 100:300] = cv2.aruco.generateImageMarker(dictionary, 5, 200)
    corners, (number,), _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    turn = cv2.Rodrigues(cv2.solvePnP(square, corners[0][0], camera, None)[1])[0]
    (tag,) = Detector(families=f"tag{family}").detect(
        image, estimate_tag_pose=True, camera_params=(400.0, 400.0, 200.0, 200.0), tag_size=0.2
    )
    to_the_right = [bool(each[0, 0] > 0.99) for each in (turn, tag.pose_R)]  # x axis of the tag in the image
    print(family, number, tag.tag_id, tag.hamming, *to_the_right)
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "36h11 5 5 0 True False
25h9 5 5 0 True False
16h5 5 5 0 True False" ] || { echo "the behaviour has changed" >&2; exit 1; }
