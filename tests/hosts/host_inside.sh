# A host: the first process in its namespaces (net, mount, uts, ipc, pid). See spaces.py.
# FOLDER holds what outlives a reboot: home, etc, log, systemd. When this process ends, the kernel
# kills every other in the host.
set -eu
trap 'echo "failed" >&"$STATUS"' ERR

# A control group of its own, seen as the root of all groups, laid out as on a machine that systemd booted:
# the journal tells a user's units by the path.
if [ -z "${GROUPED:-}" ]; then
  mount --make-rprivate /
  hostname "$NAME"
  mount -t sysfs none /sys
  mount -t cgroup2 none /sys/fs/cgroup
  mkdir -p "/sys/fs/cgroup/$GROUP"
  echo 0 >"/sys/fs/cgroup/$GROUP/cgroup.procs"
  echo inside >&"$STATUS"
  trap - ERR
  GROUPED=1 exec unshare --cgroup bash -c 'eval "$SCRIPT"' "$GROUP"
fi
export -n HOST_PATH NAME FOLDER GROUP PYTHON_FOLDER SYSTEMD OWNER WITHOUT_NAMESPACES LIFELINE STATUS SCRIPT GROUPED # no business of the host's
umount /sys/fs/cgroup
mount -t cgroup2 none /sys/fs/cgroup
manager=/sys/fs/cgroup/user.slice/user-$OWNER.slice/user@$OWNER.service
mkdir -p /sys/fs/cgroup/init.scope "$manager" \
  /sys/fs/cgroup/system.slice/{ssh,systemd-journald}.service /sys/fs/cgroup/user.slice/user-$OWNER.slice/session-1.scope
echo 0 >/sys/fs/cgroup/init.scope/cgroup.procs
group=/sys/fs/cgroup
for below in "" user.slice "user-$OWNER.slice"; do # what the kernel lets this host control, a user may limit
  group=$group${below:+/$below}
  for controller in $(cat "$group/cgroup.controllers"); do
    echo "+$controller" >"$group/cgroup.subtree_control" || true
  done
done

[ -z "$PYTHON_FOLDER" ] || mount --bind -o ro "$PYTHON_FOLDER" "$FOLDER/python"
mount --rbind "$FOLDER" /mnt # FOLDER and PYTHON_FOLDER may lie where something else is mounted below
mount --rbind /mnt/etc /etc
mount --rbind /mnt/log /var/log
mount --rbind /mnt/systemd /var/lib/systemd
[ -d "$HOME" ] || mount -t tmpfs -o mode=755 none "${HOME%/*}"
mkdir -p "$HOME"
mount --rbind /mnt/home "$HOME"
chown "$OWNER:$OWNER" "$HOME"
mount -t tmpfs -o mode=1777 none /tmp
mount -t tmpfs -o mode=1777 none /dev/shm
mount -t tmpfs -o mode=755 none /run
mkdir /run/programs
mount --rbind /mnt/programs /run/programs
if [ -n "$PYTHON_FOLDER" ] && [ ! -e "$PYTHON_FOLDER/bin" ]; then # it finds its libraries only at its own place
  mkdir -p "$PYTHON_FOLDER"
  mount --rbind /mnt/python "$PYTHON_FOLDER"
fi
umount -l /mnt
cd /
mkdir -p /run/sshd /run/lock
ip link set lo up
PATH=$HOST_PATH
boot=$(cat /proc/sys/kernel/random/uuid)
echo "$boot" >/run/boot_id
mount --bind /run/boot_id /proc/sys/kernel/random/boot_id

in_group() { # group command...: becomes the command, in a control group
  echo 0 >"/sys/fs/cgroup/$1/cgroup.procs"
  exec {STATUS}>&- {LIFELINE}<&-
  exec "${@:2}"
}
if [ "$SYSTEMD" = yes ]; then
  mkdir -p /run/systemd/system /run/systemd/journal /run/log/journal /run/user
  mkdir -m 700 "$XDG_RUNTIME_DIR"
  mkdir -p -m 755 /run/systemd/inaccessible # these as the systemd of the machine makes them
  mkdir -m 700 /run/systemd/unit-root
  mkdir -m 0 /run/systemd/inaccessible/dir
  (umask 777 && : >/run/systemd/inaccessible/reg)
  chown -R "$OWNER:$OWNER" "$XDG_RUNTIME_DIR" "$manager"
  touch /run/systemd/journal/flushed # /var/log is there: the journal may be written to it at once
  in_group system.slice/systemd-journald.service /lib/systemd/systemd-journald &
  until [ -S /run/systemd/journal/stdout ] && [ -S /run/systemd/journal/socket ]; do sleep 0.01; done
  become=() # root needs not
  [ -z "$WITHOUT_NAMESPACES" ] || become=(python3 "$WITHOUT_NAMESPACES")
  [ "$OWNER" = 0 ] || become+=(setpriv --reuid="$OWNER" --regid="$OWNER" --init-groups)
  in_group "${manager#/sys/fs/cgroup/}" "${become[@]}" /lib/systemd/systemd --user --log-target=journal &
fi
(in_group system.slice/ssh.service /usr/sbin/sshd)
if [ "$SYSTEMD" = yes ]; then
  until [ -S "$XDG_RUNTIME_DIR/systemd/private" ]; do sleep 0.01; done
  systemctl --user is-system-running --wait >/dev/null || true # a user's own unit may have failed: no matter
fi
trap - ERR
echo ready >&"$STATUS"
exec {STATUS}>&-
read -r -u "$LIFELINE" _ || true # until the test run closes its end, or is no more
