# overlay.sh ROOT: what makes a plain Debian the stand-in for a Jetson. KEY: public key of who may log in as `robot`.
set -eu
root=$1
echo modcube-guest > "$root/etc/hostname"
echo '127.0.0.1 localhost modcube-guest' > "$root/etc/hosts"
echo '/dev/vda / ext4 defaults,noatime 0 1' > "$root/etc/fstab"
echo '/dev/vdb /opt/modcube/plant ext4 ro,nofail 0 0' >> "$root/etc/fstab"
chroot "$root" useradd --create-home --shell /bin/bash robot
mkdir -p "${root}/home/robot/.ssh" "$root/etc/modcube" "$root/opt/modcube/plant" "$root/etc/systemd/system/multi-user.target.wants"
echo "$KEY" > "${root}/home/robot/.ssh/authorized_keys"
chroot "$root" sh -c 'chown -R robot:robot ~robot /opt/modcube'
chmod 700 "${root}/home/robot/.ssh"
echo 'robot ALL=(ALL) NOPASSWD: ALL' > "$root/etc/sudoers.d/robot"
printf 'UseDNS no\nGSSAPIAuthentication no\n' > "$root/etc/ssh/sshd_config.d/guest.conf"
# The same processor is compiled for inside and outside, so that compiled code can be brought along.
echo 'NUMBA_CPU_NAME=generic' >> "$root/etc/environment"
cat > "$root/etc/modcube/modcube.env" <<'EOF'
NUMBA_CPU_NAME=generic
MODCUBE_ARGUMENTS=--bus socketcan:vcan0 --hold --out /var/lib/modcube/log
EOF
unit() { cat > "$root/etc/systemd/system/$1"; ln -s "../$1" "$root/etc/systemd/system/multi-user.target.wants/$1"; }
unit guest-net.service <<'EOF'
[Unit]
DefaultDependencies=no
Before=ssh.service
[Service]
Type=oneshot
RemainAfterExit=yes
ExecStart=/bin/sh -c 'ip link set lo up; cd /sys/class/net; for i in e*; do ip link set $i up; ip addr add 10.0.2.15/24 dev $i; done'
ExecStart=/bin/sh -c 'ip route add 224.0.0.0/4 dev lo; ip link add vcan0 type vcan; ip link set vcan0 txqueuelen 200 up'
EOF
# An idle machine's counted clock jumps while files are waited for.
unit guest-spinner.service <<'EOF'
[Service]
ExecStart=/usr/bin/chrt --idle 0 /bin/sh -c 'while :; do :; done'
EOF
unit guest-plant.service <<'EOF'
[Unit]
RequiresMountsFor=/opt/modcube/plant
StartLimitIntervalSec=0
[Service]
User=robot
EnvironmentFile=/etc/modcube/modcube.env
ExecStart=/opt/modcube/plant/bin/modcube hil plant hover --bus socketcan:vcan0
Restart=always
RestartSec=1
CPUSchedulingPolicy=fifo
CPUSchedulingPriority=40
EOF
for masked in serial-getty@ttyS0.service getty@tty1.service systemd-networkd-wait-online.service apt-daily.timer \
        apt-daily-upgrade.timer e2scrub_all.timer fstrim.timer systemd-timesyncd.service systemd-udev-settle.service; do
    ln -sf /dev/null "$root/etc/systemd/system/$masked"
done
rm -f "$root"/etc/ssh/ssh_host_*
chroot "$root" ssh-keygen -q -t ed25519 -N '' -f /etc/ssh/ssh_host_ed25519_key
