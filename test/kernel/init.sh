#!/bin/sh
# First process of the guest kernel: CAN modules, a place to write, then what the host asks for (SHARED/command).
export PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/run/home TMPDIR=/run/tmp
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /run
mkdir -p /run/home /run/tmp /dev/shm
mount -t tmpfs tmpfs /dev/shm
modules=/usr/lib/uml/modules/$(uname -r)/kernel
for module in net/can/can net/can/can-raw drivers/net/can/dev/can-dev drivers/net/can/vcan drivers/net/can/vxcan net/sched/sch_netem; do
  insmod "$modules/$module.ko" || echo "no module $module"
done
ip link set lo up
# The root file system is the host's, and can only be read, but for the repository, where the firmware is built; for the
# cache of compiled code, since to compile it here takes longer than the tests; and for the folder of the results.
for folder in "$REPOSITORY" "$CACHE"; do
  mount -t hostfs -o "$folder" none "$folder"
done
mkdir /run/shared
mount -t hostfs -o "$SHARED" none /run/shared
sh /run/shared/command > /run/shared/output 2>&1
echo $? > /run/shared/code
halt -f -p
