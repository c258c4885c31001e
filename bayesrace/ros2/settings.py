"""Where the ROS network is, and which topics, frames, rates and buttons; all in a TOML file."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field

from bayesrace.errors import InputError
from bayesrace.files import read_form
from bayesrace.transport.endpoints import Endpoint, address_of
from bayesrace.units import Section

__all__ = ["CarTopics", "Joy", "Outputs", "Ros2Settings"]

_WORD: Final = "[A-Za-z_][A-Za-z0-9_]*"
Name = Annotated[str, Field(pattern=f"^/?{_WORD}(/{_WORD})*$", max_length=200)]
Rate = Annotated[float, Field(ge=0, le=500)]
Deviation = Annotated[float, Field(ge=1e-6, le=100)]
Seconds = Annotated[float, Field(ge=0, le=2)]
Instrument = Literal["pose", "odometry", "imu", "wheels"]
Button = Annotated[int, Field(ge=0, le=63)]


class Outputs(Section):
    """Topics that 'bayesrace ros2' publishes, and how often at most; at 0 not at all."""

    odometry: Name = "odom"
    tf: Name = "/tf"
    state_hz: Rate = Field(50.0, description="of odometry and tf")
    drive: Name = "drive"
    drive_hz: Rate = 50.0
    plan: Name = "plan"
    tube: Name = "tube"
    plan_hz: Rate = Field(10.0, description="of plan and tube")
    track: Name = Field("track", description="published once, latched")


class Joy(Section):
    """Buttons of sensor_msgs/Joy."""

    topic: Name = "/joy"
    stop_button: Button = 1
    go_button: Button = 0


class CarTopics(Section):
    """A real car's topics, and how they are read; one that is empty is not read."""

    pose: Name | Literal[""] = "/pose"
    odometry: Name | Literal[""] = "/odom"
    imu: Name | Literal[""] = "/imu"
    wheels: Name | Literal[""] = Field("", description="sensor_msgs/JointState")
    wheel_radius_m: float = Field(0.05, gt=0, le=2)
    wheel_joints: tuple[str, ...] = Field((), description="names of the wheels; none: all joints")
    drive: Name = Field("/drive", description="of the commands to the car")
    position_m: Deviation = Field(0.01, description="standard deviation where none is stated")
    heading_rad: Deviation = 0.01
    speed_mps: Deviation = 0.1
    yaw_rate_radps: Deviation = 0.02
    delays_s: dict[Instrument, Seconds] = Field(
        {}, description="by instrument: measuring to arrival"
    )
    command_s: Seconds = Field(0.0, description="from sending a command to its acting")


class Ros2Settings(Section):
    """How we take part in a ROS 2 network of rmw_zenoh."""

    endpoint: Endpoint = Field("tcp/localhost:7447", description="of its router, rmw_zenohd")
    domain_id: int = Field(0, ge=0, le=232, description="ROS_DOMAIN_ID")
    namespace: Name = Field("/bayesrace", description="of our nodes, and of relative topics")
    world_frame: str = Field("map", description="frame of the track's coordinates")
    car_frame: str = "base_link"
    centre_ahead_m: float = Field(
        0.0, ge=-10, le=10, description="centre of gravity ahead of the car's frame"
    )
    speed_lead_s: Seconds = Field(0.1, description="speed commanded: that after this time")
    publish: Outputs = Outputs()
    joy: Joy = Joy()
    car: CarTopics = CarTopics()

    @classmethod
    def chosen(cls, file: Path | None, endpoint: str = "", insecure: bool = False) -> Self:
        """Those of a file, or the defaults, at the endpoint if one is given.

        InputError names what is wrong, an endpoint beyond loopback included unless ``insecure``.
        """
        remedy = "all settings are in docs/ros2.md"
        found = cls() if file is None else read_form(file, "ROS settings", remedy, cls)
        found = found.model_copy(update={"endpoint": endpoint or found.endpoint})
        if not address_of(found.endpoint).loopback and not insecure:
            raise InputError(
                f"{found.endpoint}: anyone in that ROS network could drive the car: run "
                "rmw_zenohd here and connect it to theirs, or accept it with --insecure"
            )
        return found

    def absolute(self, topic: str) -> str:
        """A topic's fully qualified name."""
        return topic if topic.startswith("/") else f"/{self.namespace.strip('/')}/{topic}"
