"""A scripted PX4, written from the MAVLink protocol: a program that is started as PX4 is.

It connects to the simulator, is silent for its first steps as PX4 is, then answers each HIL_SENSOR
with the controls of deterministic position, velocity, attitude and rate loops on ODOMETRY and the
gyroscope. Gains and thrust curve are those of ``px4-rc.params``. ``PEER_FAULT=KIND@STEP`` makes it
misbehave from an answer on: silent, closes, late, twice, nan, time, deny.
"""

import os
import socket
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

SILENT_STEPS = 15
GRAVITY = 9.81
OFFBOARD = 6 << 16
_ROLL = np.sqrt(0.5) * np.array([-1.0, 1.0, 1.0, -1.0])
_PITCH = np.sqrt(0.5) * np.array([1.0, -1.0, 1.0, -1.0])
_YAW = np.array([1.0, 1.0, -1.0, -1.0])
"""of front right, rear left, front left, rear right for torques about forward, right, down"""


def make_build(folder: Path) -> Path:
    """A folder that looks like a SITL build, whose px4 is this file."""
    program, script = folder / "bin/px4", folder / "etc/init.d-posix/rcS"
    program.parent.mkdir(parents=True)
    script.parent.mkdir(parents=True)
    script.write_text("")
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -P "{__file__}" "$@"\n')
    program.chmod(0o755)
    return folder


class Peer:
    """The autopilot behind the two sockets."""

    def __init__(self, instance: int) -> None:
        lines = Path("px4-rc.params").read_text().splitlines()
        self.gains = {name: float(value) for _, _, name, value in map(str.split, lines)}
        self.mav = common.MAVLink(None, srcSystem=instance + 1, srcComponent=1)
        self.udp = socket.socket(type=socket.SOCK_DGRAM)
        self.udp.bind(("127.0.0.1", 14580 + instance))
        self.udp.setblocking(False)
        self.computer = ("127.0.0.1", 14540 + instance)
        self.tcp = self._connected(4560 + instance)
        kind, _, step = os.environ.get("PEER_FAULT", "").partition("@")
        self.fault, self.fault_step = kind, int(step or 0)
        self.steps = self.received = 0
        self.seen_at = self.resets = 0
        self.armed, self.mode = False, 0
        self.rotation: Any = None
        self.position = self.velocity = np.zeros(3)
        self.integral = np.zeros(3)
        self.gyro = np.zeros(3)
        self.target: Any = None

    def _connected(self, port: int) -> socket.socket:
        while True:
            tcp = socket.socket()
            if tcp.connect_ex(("127.0.0.1", port)) == 0:
                tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return tcp
            tcp.close()
            time.sleep(0.02)

    def run(self) -> None:
        """Until the simulator closes."""
        self._answer(self._heartbeat())
        self._answer(common.MAVLink_command_long_message(0, 0, 511, 0, 115, 5000, 0, 0, 0, 0, 0))
        while data := self.tcp.recv(1 << 16):
            for message in self.mav.parse_buffer(data) or ():
                if message.get_type() == "ODOMETRY":
                    self._take_odometry(message)
                elif message.get_type() == "HIL_SENSOR":
                    self._step(message)

    def _step(self, sensors: Any) -> None:
        self.received += 1
        self._predict(sensors)
        self._read_commands()
        if self.received == self.seen_at + 100:
            self._warn("no vision")
        if self.received % 200 == SILENT_STEPS + 1:
            self._say(self._heartbeat())
        if self.received <= SILENT_STEPS:
            return
        self.steps += 1
        controls = self._controls() if self.armed else [0.0] * 4
        self._misbehave(sensors, controls)
        self._answer(self._actuators(int(sensors.time_usec), controls))

    def _misbehave(self, sensors: Any, controls: list[float]) -> None:
        if not self.fault or self.steps < self.fault_step or self.fault == "deny":
            return
        if self.fault == "silent":
            time.sleep(600.0)
        elif self.fault == "closes":
            sys.exit(3)
        elif self.fault == "late":
            time.sleep(3.0)
        elif self.fault == "twice":
            self._answer(self._actuators(int(sensors.time_usec), controls))
        elif self.fault == "nan":
            controls[2] = float("nan")
        elif self.fault == "time":
            sensors.time_usec += 1000

    def _actuators(self, time_us: int, controls: list[float]) -> Any:
        mode = common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        mode |= common.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return common.MAVLink_hil_actuator_controls_message(
            time_us, [*controls, *[0.0] * 12], mode, 1
        )

    def _answer(self, message: Any) -> None:
        self.tcp.sendall(message.pack(self.mav))

    def _say(self, message: Any) -> None:
        self.udp.sendto(message.pack(self.mav), self.computer)

    def _warn(self, text: str) -> None:
        severity = common.MAV_SEVERITY_WARNING
        self._say(common.MAVLink_statustext_message(severity, text.encode()))

    def _heartbeat(self) -> Any:
        armed = common.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return common.MAVLink_heartbeat_message(2, common.MAV_AUTOPILOT_PX4, armed, self.mode, 3, 3)

    def _read_commands(self) -> None:
        while True:
            try:
                data = self.udp.recv(1 << 16)
            except BlockingIOError:
                return
            for message in self.mav.parse_buffer(data) or ():
                if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                    self.target = message
                elif message.get_type() == "COMMAND_LONG":
                    self._obey(message)

    def _obey(self, command: Any) -> None:
        assert command.target_system == self.mav.srcSystem
        if command.command == common.MAV_CMD_DO_SET_MODE:
            self.mode = int(command.param2) << 16
            self._say(self._heartbeat())
        elif command.command == common.MAV_CMD_COMPONENT_ARM_DISARM:
            known = self.target is not None and self.rotation is not None
            ready = self.mode == OFFBOARD and known
            if command.param1 == 1.0 and not (ready and self.fault != "deny"):
                print(
                    "\x1b[33mWARN  [commander] Arming denied\x1b[0m\nERROR [param] none", flush=True
                )
                self._warn("Arming denied: no valid position")
            else:
                self.armed = command.param1 == 1.0

    # ---------------------------------------------------------------------------- the loops

    def _predict(self, sensors: Any) -> None:
        self.gyro = np.array([sensors.xgyro, sensors.ygyro, sensors.zgyro])
        if self.rotation is None:
            return
        force = self.rotation @ np.array([sensors.xacc, sensors.yacc, sensors.zacc])
        force[2] += GRAVITY
        step = 1.0 / self.gains["IMU_INTEG_RATE"]
        self.position = self.position + step * self.velocity
        self.velocity = self.velocity + step * force
        x, y, z = step * self.gyro
        self.rotation = self.rotation @ np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])

    def _take_odometry(self, message: Any) -> None:
        self.seen_at = self.received
        if message.reset_counter != self.resets:
            self.resets = message.reset_counter
            self._warn(f"vision reset {self.resets}")
        w, x, y, z = message.q
        self.rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        self.position = np.array([message.x, message.y, message.z])
        self.velocity = np.array([message.vx, message.vy, message.vz])

    def _controls(self) -> list[float]:
        target, gains = self.target, self.gains
        position = np.array([gains["MPC_XY_P"], gains["MPC_XY_P"], gains["MPC_Z_P"]])
        velocity = np.array([3.0, 3.0, 6.0])
        wanted = np.array([target.vx, target.vy, target.vz])
        wanted = wanted + position * (np.array([target.x, target.y, target.z]) - self.position)
        error = wanted - self.velocity
        self.integral = np.clip(self.integral + error / gains["IMU_INTEG_RATE"], -3.0, 3.0)
        forward = np.array([target.afx, target.afy, target.afz])
        acceleration = forward + velocity * error + self.integral
        if target.type_mask & 4:
            acceleration[2], self.integral = target.afz, np.zeros(3)
        thrust = acceleration - np.array([0.0, 0.0, GRAVITY])
        thrust[2] = min(thrust[2], -1e-3)
        lift = -thrust / np.linalg.norm(thrust)
        size = gains["MPC_THR_HOVER"] * float(-thrust @ self.rotation[:, 2]) / GRAVITY
        right = np.cross(lift, [np.cos(target.yaw), np.sin(target.yaw), 0.0])
        right /= np.linalg.norm(right)
        aim = np.column_stack([np.cross(right, lift), right, lift])
        turn = self.rotation.T @ aim
        angle = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0],
                                turn[1, 0] - turn[0, 1]])  # fmt: skip
        names = ("ROLL", "PITCH", "YAW")
        rates = np.array([gains[f"MC_{name}_P"] for name in names]) * angle
        roll, pitch, yaw = np.array([gains[f"MC_{n}RATE_P"] for n in names]) * (rates - self.gyro)
        fractions = np.clip(max(size, 0.0) + roll * _ROLL + pitch * _PITCH + yaw * _YAW, 0.0, 1.0)
        bend = gains["THR_MDL_FAC"]
        root = np.sqrt((1.0 - bend) ** 2 + 4.0 * bend * fractions)
        return [float(u) for u in (root - (1.0 - bend)) / (2.0 * bend)]


if __name__ == "__main__":
    Peer(int(sys.argv[sys.argv.index("-i") + 1])).run()
