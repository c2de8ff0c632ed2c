#!/bin/bash
# Start systemd as PID 1 of the namespaces that own_systemd.py made: boot_machine.sh FOLDER SYSTEMD
# It sees the files of this machine. Changes in /etc, /var, /run, /tmp and /dev stay in the namespaces.
set -eu
folder=$1
mount --make-rprivate /
mount -t tmpfs tmpfs "$folder/own"
for name in etc var; do
    mkdir -p "$folder/own/$name/upper" "$folder/own/$name/work"
    mount -t overlay overlay -o "lowerdir=/$name,upperdir=$folder/own/$name/upper,workdir=$folder/own/$name/work" "/$name"
done
rm -rf /etc/systemd/system /var/log/journal # the journal stays in /run
mkdir -p /etc/systemd/system
mount -t tmpfs -o mode=755 tmpfs /run
shared=$(dirname "$folder") # the tests' files; the rest of /tmp is the namespace's own
mkdir /run/shared
mount --rbind "$shared" /run/shared
mount -t tmpfs -o mode=1777 tmpfs /tmp
mkdir -p "$shared"
mount --move /run/shared "$shared"

mkdir "$folder/own/dev"
mount -t tmpfs -o mode=755 tmpfs "$folder/own/dev"
cd "$folder/own/dev"
device() { mknod -m 666 "$1" c "$2" "$3"; }
device null 1 3
device zero 1 5
device full 1 7
device random 1 8
device urandom 1 9
device tty 5 0
device ptmx 5 2
mkdir pts shm
mount --bind /dev/pts pts # the emulator of a test opens pseudo terminals there
mount -t tmpfs -o mode=1777 tmpfs shm
ln -s /proc/self/fd fd
cd /
mount --move "$folder/own/dev" /dev

mount -t proc proc /proc
umount -R /sys/fs/cgroup
mount -t cgroup2 cgroup2 /sys/fs/cgroup
hostname machine
exec env -i "PATH=$PATH" container=bodyschema-test "SYSTEMD_UNIT_PATH=/etc/systemd/system:$folder/units" \
    "SYSTEMD_GENERATOR_PATH=$folder/none" "SYSTEMD_ENVIRONMENT_GENERATOR_PATH=$folder/none" \
    "$2" --system --unit=machine.target --log-target=journal --show-status=no
