# What a host holds, one thing a line, under `## SECTION`; run with `docker exec`, $1 is the parent of its containers' cgroups.
set -eu
export LC_ALL=C

echo '## processes'
# Our own session is this script.
ps -eww -o sid=,user:32=,args= | awk -v own="$(ps -o sid= $$)" '$1 != own + 0 { $1 = ""; print substr($0, 2, 300) }'

echo '## sockets'
# 127.0.0.11 is the outer engine's name server, whose ports change with the cable.
{
    ss -Hlntup | awk '{ print $1, $5, $7 }'
    ss -Hlxp | awk '{ print $1, $5, $9 }'
} | grep -v '127\.0\.0\.11:' | sed -E -e 's/users:\(\(("[^"]*").*/\1/' -e 's/@[0-9a-f]{5}( |$)/@\1/' -e 's/[0-9a-f]{12}\.sock/ID.sock/'

echo '## mounts'
# What the engine makes with the first container and keeps for itself is left out.
awk '{ for (i = 7; $i != "-"; i++); print $5, $(i + 1), $(i + 2) }' /proc/self/mountinfo |
    grep -v '^/run/docker/netns/default ' || true

echo '## cgroups'
own=$(sed -n 's/^[0-9]*:[a-z]*memory[a-z,]*://p' /proc/1/cgroup)
for tree in /sys/fs/cgroup /sys/fs/cgroup/*/; do
    for group in "$1" "$own"; do
        case $group in
        '' | /) ;;
        *) if [ -d "$tree$group" ]; then find "$tree$group" -mindepth 1 -type d; fi ;;
        esac
    done
done
find /sys/fs/cgroup -maxdepth 2 -type d -name '*ictus*' ! -name 'ictus-rig-*'

echo '## iptables'
for family in iptables ip6tables; do
    "$family-save" 2>/dev/null | awk -v family="$family" '/^\*/ { table = substr($0, 2) } /127\.0\.0\.11|--to-source :53/ { next } /^[-:]/ { sub(/ \[.*/, ""); print family, table, $0 }'
done

echo '## engine'
if timeout 20 docker version >/dev/null 2>&1; then
    docker ps --all --no-trunc --format 'container {{.Names}} of {{.Image}}, {{.State}}'
    docker image ls --all --no-trunc --format 'image {{.Repository}}:{{.Tag}} {{.ID}}'
    docker volume ls --format 'volume {{.Name}}'
    docker network ls --format 'network {{.Name}} {{.Driver}}'
else
    echo 'does not answer'
fi

echo '## files'
# Docker's own run-time files come and go with its containers, which are listed above; sudo's tell who asked it.
# /run/mount is what mount(8) makes when it is first used.
find /home /root /tmp /var/tmp /dev/shm /run /srv /opt /usr/local /etc /var/lib/ictus /var/spool \
    \( -path /run/docker -o -path /run/sudo -o -path /run/containerd -o -path /run/docker.pid -o -path /run/xtables.lock -o -path /run/mount \
    -o -path /etc/hosts -o -path /etc/resolv.conf \) -prune -o \
    \( -type f ! -path '/run/*' -printf '%M %u %p %s bytes\n' -o -printf '%M %u %p\n' \) 2>/dev/null || true
