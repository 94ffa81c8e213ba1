"""Messages of ROS 2 as DDS sends them: ``geometry_msgs`` and what these are made of, without a ROS installation.

Names, order and types of the fields are those of ``common_interfaces``. There are no messages with arrays, such as
``Odometry``: Cyclone's Python types and Fast DDS, ROS 2's default, do not agree on how to describe these to each other.
"""

from dataclasses import dataclass, field

try:
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import float64, int32, uint32
except ImportError as error:
    raise ImportError("redig.deploy.dds needs Cyclone DDS: pip install 'redig[ros2]'") from error


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """``builtin_interfaces/Time``.

    Examples:
        >>> Time(1, 500_000_000).seconds()
        1.5
    """

    sec: int32 = 0
    nanosec: uint32 = 0

    @classmethod
    def of(cls, stamp: float) -> "Time":
        """From seconds; held within what the type can hold."""
        nanoseconds = round(min(max(stamp, -(2.0**31)), 2.0**31 - 1) * 1e9)
        return cls(nanoseconds // 10**9, nanoseconds % 10**9)

    def seconds(self) -> float:
        """As seconds."""
        return self.sec + 1e-9 * self.nanosec


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """``std_msgs/Header``.

    Examples:
        >>> Header(Time(1), "map").frame_id
        'map'
    """

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """``geometry_msgs/Vector3``.

    Examples:
        >>> Vector3(0.5).y
        0.0
    """

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """``geometry_msgs/Point``.

    Examples:
        >>> Point(0.5).y
        0.0
    """

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """``geometry_msgs/Quaternion``.

    Examples:
        >>> Quaternion().w
        1.0
    """

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """``geometry_msgs/Pose``.

    Examples:
        >>> Pose(Point(0.5)).position.x
        0.5
    """

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """``geometry_msgs/PoseStamped``.

    Examples:
        >>> PoseStamped(pose=Pose(Point(0.5))).pose.position.x
        0.5
    """

    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    """``geometry_msgs/Twist``.

    Examples:
        >>> Twist(Vector3(0.5)).linear.x
        0.5
    """

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TwistStamped_"):
    """``geometry_msgs/TwistStamped``.

    Examples:
        >>> TwistStamped(twist=Twist(Vector3(0.5))).twist.linear.x
        0.5
    """

    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
class Vector3Stamped(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3Stamped_"):
    """``geometry_msgs/Vector3Stamped``.

    Examples:
        >>> Vector3Stamped(vector=Vector3(0.5)).vector.x
        0.5
    """

    header: Header = field(default_factory=Header)
    vector: Vector3 = field(default_factory=Vector3)
