"""A MAVLink session, sans-IO: heartbeat, TIMESYNC, streams, parameters, commands, signing."""
