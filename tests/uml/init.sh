#!/bin/bash
# First process of the guest: loads CAN, brings up vcan0, runs the job, tells its exit status, powers off.
# The kernel hands over the folder of the job as ATO_HIL_GUEST.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /run
mkdir -p /dev/shm /run/tmp /run/user
mount -t tmpfs tmpfs /dev/shm
chmod 1777 /run/tmp
chmod 700 /run/user

prepare() {
	local modules drivers
	modules=/usr/lib/uml/modules/$(uname -r)/kernel/net/can
	drivers=/usr/lib/uml/modules/$(uname -r)/kernel/drivers/net/can
	for module in "$modules"/can.ko "$drivers"/dev/can-dev.ko "$drivers"/vcan.ko \
		"$modules"/can-raw.ko "$modules"/can-bcm.ko; do
		insmod "$module" || return
	done
	ip link set lo up && ip link add dev vcan0 type vcan && ip link set up vcan0
}

if prepare; then
	"$ATO_HIL_GUEST/job" </dev/null 2>&1 | cat # no terminal
	echo "${PIPESTATUS[0]}" >"$ATO_HIL_GUEST/status"
fi
sync
echo o >/proc/sysrq-trigger
sleep infinity
