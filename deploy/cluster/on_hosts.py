"""placeholder"""
from typing import Any
HostsCluster: Any = None
