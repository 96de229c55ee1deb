#!/bin/busybox sh
# First process of the bench machine: modules, the host's root by 9p, one writable folder, the job, off.
/bin/busybox mkdir -p /proc /sys /dev /root
/bin/busybox mount -t proc proc /proc
/bin/busybox mount -t sysfs sys /sys
/bin/busybox mount -t devtmpfs dev /dev
while read -r module; do /bin/busybox insmod "/modules/$module" || echo "insmod $module failed"; done < /modules/order
options=trans=virtio,version=9p2000.L,msize=524288,cache=loose
/bin/busybox mount -t 9p -o "$options,ro" host /root || echo "mounting the host's root failed"
/bin/busybox mount -t proc proc /root/proc
/bin/busybox mount -t sysfs sys /root/sys
/bin/busybox mount -t devtmpfs dev /root/dev
/bin/busybox mkdir -p /root/dev/shm /root/dev/pts
/bin/busybox mount -t tmpfs -o mode=1777 shm /root/dev/shm
/bin/busybox mount -t devpts pts /root/dev/pts
/bin/busybox mount -t 9p -o "$options" out /root/mnt || echo "mounting the writable folder failed"
/bin/busybox chroot /root /bin/bash /mnt/job.sh > /root/dev/shm/job.stdout 2> /root/dev/shm/job.stderr
echo $? > /root/dev/shm/job.code
/bin/busybox cp /root/dev/shm/job.stdout /root/mnt/stdout
/bin/busybox cp /root/dev/shm/job.stderr /root/mnt/stderr
/bin/busybox cp /root/dev/shm/job.code /root/mnt/code
/bin/busybox sync
echo o > /proc/sysrq-trigger
/bin/busybox sleep 60
