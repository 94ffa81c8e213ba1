"""The other side of a robot, by ROS 2's own client library; run by the Python that has rclpy.

It plays the localisation of robot_0 and its neighbour robot_1, and prints as JSON what it hears of robot_0.
"""

import json
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped, Vector3Stamped

KINDS = {"pose": PoseStamped, "twist": TwistStamped, "goal": PoseStamped, "obstacle": Vector3Stamped}


def stamped(kind, node, frame="map"):
    message = kind()
    message.header.stamp, message.header.frame_id = node.get_clock().now().to_msg(), frame
    return message


def publish(writers, node, position, quaternion, velocity, goal, obstacle):
    pose, twist = stamped(PoseStamped, node), stamped(TwistStamped, node)
    (pose.pose.position.x, pose.pose.position.y), pose.header.stamp = position, twist.header.stamp
    pose.pose.orientation.z, pose.pose.orientation.w = quaternion
    twist.twist.linear.x, twist.twist.linear.y = velocity
    target, vector = stamped(PoseStamped, node), stamped(Vector3Stamped, node)
    target.pose.position.x, target.pose.position.y = goal
    vector.vector.x, vector.vector.y = obstacle
    for name, message in {"twist": twist, "goal": target, "obstacle": vector, "pose": pose}.items():
        writers[name].publish(message)


def main(seconds):
    rclpy.init()
    node = rclpy.create_node("peer")
    own, mate = (
        {name: node.create_publisher(kind, f"{namespace}/{name}", 10) for name, kind in KINDS.items()}
        for namespace in ("/robot_0", "/robot_1/team")
    )
    heard = {"cmd_vel": [], "pose": [], "twist": [], "goal": [], "obstacle": []}

    def hear(name, *fields):
        def take(message):
            values = []
            for field in fields:
                value = message
                for part in field.split("."):
                    value = getattr(value, part)
                values.append(value)
            heard[name].append(values)

        return take

    reads = {
        "pose": ("header.frame_id", "pose.position.x", "pose.position.y", "pose.orientation.z"),
        "twist": ("twist.linear.x", "twist.linear.y"),
        "goal": ("pose.position.x", "pose.position.y"),
        "obstacle": ("vector.x", "vector.y"),
    }
    for name, fields in reads.items():
        node.create_subscription(KINDS[name], f"/robot_0/team/{name}", hear(name, *fields), 10)
    node.create_subscription(Twist, "/robot_0/cmd_vel", hear("cmd_vel", "linear.x", "linear.y", "angular.z"), 10)
    end = time.monotonic() + seconds
    while time.monotonic() < end and any(len(messages) < 20 for messages in heard.values()):
        publish(own, node, (1.0, 2.0), (0.6, 0.8), (0.25, 0.0), (6.0, 0.0), (0.0, -0.5))
        publish(mate, node, (1.5, 2.0), (0.0, 1.0), (0.0, 0.5), (6.5, 0.0), (0.0, -0.75))
        rclpy.spin_once(node, timeout_sec=0.02)
    print(json.dumps(heard))
    rclpy.shutdown()


if __name__ == "__main__":
    main(float(sys.argv[1]))
