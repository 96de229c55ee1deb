#!/busybox sh
# First process of the bench machine: modules, the Python that stands by and does the job, what it left, off.
/busybox mkdir -p /proc /sys /dev /host
/busybox mount -t proc proc /proc
/busybox mount -t sysfs sys /sys
/busybox mount -t devtmpfs dev /dev
while read -r module; do /busybox insmod "/modules/$module" || echo "insmod $module failed"; done < /modules/order
read -r python < /standby/python
# numba fixes its processor with the first import that compiles, which here comes before the tree says which
/busybox env -i LANG=C.UTF-8 HOME=/dev/shm PYTHONDONTWRITEBYTECODE=1 OPENBLAS_NUM_THREADS=1 \
    NUMBA_CPU_NAME=generic "$python" /standby/standby.py
code=$?
for name in stdout stderr; do /busybox cp "/host/dev/shm/job.$name" "/host/mnt/$name"; done
echo "$code" > /host/mnt/code
/busybox sync
echo o > /proc/sysrq-trigger
/busybox sleep 60
