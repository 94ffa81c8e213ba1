"""The other side of a robot, by rospy; run by the system's Python.

It plays the localisation of robot_0 and its neighbour robot_1, and prints as JSON what it hears of robot_0.
"""

import json
import sys
import time

import rospy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Twist, TwistStamped, Vector3, Vector3Stamped
from std_msgs.msg import Header

KINDS = {"pose": PoseStamped, "twist": TwistStamped, "goal": PoseStamped, "obstacle": Vector3Stamped}


def publish(writers, position, quaternion, velocity, goal, obstacle):
    header = Header(stamp=rospy.Time.from_sec(time.time()), frame_id="map")
    writers["twist"].publish(header, Twist(linear=Vector3(*velocity, 0.0)))
    writers["goal"].publish(header, Pose(position=Point(*goal, 0.0)))
    writers["obstacle"].publish(header, Vector3(*obstacle, 0.0))
    writers["pose"].publish(header, Pose(Point(*position, 0.0), Quaternion(0.0, 0.0, *quaternion)))


def main(seconds):
    rospy.init_node("peer", disable_signals=True)
    own, mate = (
        {name: rospy.Publisher(f"{namespace}/{name}", kind, queue_size=10) for name, kind in KINDS.items()}
        for namespace in ("/robot_0", "/robot_1/team")
    )
    heard = {"cmd_vel": [], "team": []}
    rospy.Subscriber(
        "/robot_0/cmd_vel", Twist, lambda m: heard["cmd_vel"].append([m.linear.x, m.linear.y, m.angular.z])
    )
    rospy.Subscriber(
        "/robot_0/team/pose",
        PoseStamped,
        lambda m: heard["team"].append([m.header.frame_id, m.pose.position.x, m.pose.position.y, m.pose.orientation.z]),
    )
    end = time.monotonic() + seconds
    while time.monotonic() < end and any(len(messages) < 20 for messages in heard.values()):
        publish(own, (1.0, 2.0), (0.6, 0.8), (0.25, 0.0), (6.0, 0.0), (0.0, -0.5))
        publish(mate, (1.5, 2.0), (0.0, 1.0), (0.0, 0.5), (6.5, 0.0), (0.0, -0.75))
        time.sleep(0.02)
    print(json.dumps(heard))


if __name__ == "__main__":
    main(float(sys.argv[1]))
