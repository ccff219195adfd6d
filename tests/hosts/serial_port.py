"""A simulated rover behind a serial port, as a pseudo terminal of the group that serial ports are of.

python serial_port.py FILE PORT ARGUMENT...      # of the simulator, which sends to UDP PORT of this machine

Writes the port's path into FILE when it is there.
"""

import contextlib
import grp
import os
import pathlib
import select
import socket
import subprocess
import sys
import tty

file, port, *arguments = sys.argv[1:]
rover, line = os.openpty()
tty.setraw(line)
device = os.ttyname(line)
os.chown(device, 0, grp.getgrnam("dialout").gr_gid)
os.chmod(device, 0o660)
os.set_blocking(rover, False)
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as near:
    near.bind(("127.0.0.1", int(port)))
    with subprocess.Popen([sys.executable, "-P", "-m", "bridges.mavlink.simulator", *arguments]):
        pathlib.Path(file).write_text(device)
        sender = None
        while True:
            ready, _, _ = select.select((near, rover), (), ())
            if near in ready:
                data, sender = near.recvfrom(65_536)
                with contextlib.suppress(BlockingIOError):  # nobody reads the port
                    os.write(rover, data)
            if rover in ready and sender is not None:
                near.sendto(os.read(rover, 4096), sender)
