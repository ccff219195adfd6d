# The operator's computer: the first process in its namespaces (net, mount, uts). See spaces.py.
# HOME_DIR becomes the user's home ($HOME). The folders in KEEP (one a line), which lie in the real home, stay
# reachable at their place: the Python under test may be there. ETC_HOSTS becomes /etc/hosts. Homes of
# limited size are mounted here, so that they outlive a host's reboot: SMALL_HOMES, lines "MIB FOLDER".
set -eu
mount --make-rprivate /
mount -t sysfs none /sys
while read -r folder; do
  [ -n "$folder" ] || continue
  place=$HOME_DIR/${folder#"$HOME"/}
  mkdir -p "$place"
  mount --rbind "$folder" "$place"
done <<<"$KEEP"
while read -r mebibytes folder; do
  [ -n "$folder" ] || continue
  mount -t tmpfs -o "size=${mebibytes}m,mode=700" "$NAME" "$folder"
done <<<"$SMALL_HOMES"
mount --rbind "$HOME_DIR" "$HOME"
mount --bind "$ETC_HOSTS" /etc/hosts
hostname operator
ip -batch - <<'END'
link set lo up
link add br0 type bridge stp_state 0 forward_delay 0
link set br0 up
link add eth0 type veth peer name port0
link set port0 master br0 up
link set eth0 up
END
ip address add "$ADDRESS" dev eth0
cd /
echo ready >&"$STATUS"
exec {STATUS}>&-
read -r -u "$LIFELINE" _ || true # until the test run closes its end, or is no more
