"""An operator who puts a simulated rover into GUIDED and arms it.

python hand_over.py PORT      # TCP, of the rover's ground station
"""

import sys
import time

from pymavlink import mavutil

GUIDED = 15

station = mavutil.mavlink_connection(f"tcp:127.0.0.1:{sys.argv[1]}", source_system=255)
while True:
    beat = station.wait_heartbeat(timeout=10)
    if beat is None:
        sys.exit("no rover there")
    mav = station.mav
    if beat.custom_mode != GUIDED:
        mav.set_mode_send(beat.get_srcSystem(), mavutil.mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, GUIDED)
    elif not beat.base_mode & mavutil.mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
        arm = mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM
        mav.command_long_send(beat.get_srcSystem(), 1, arm, 0, 1, 0, 0, 0, 0, 0, 0)
    else:
        break
    time.sleep(0.1)
