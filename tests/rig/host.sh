#!/bin/sh
# What runs inside a test host. `host up CGROUP` is the child of its first process; the rest is called with `docker exec`.
set -eu

# Seconds until a part that does not start or stop is an error: some times what a machine full of compilers needs.
bound=90

# until_true MESSAGE COMMAND...
until_true() {
    message=$1
    shift
    end=$(($(date +%s) + bound))
    until "$@" >/dev/null 2>&1; do
        if [ "$(date +%s)" -ge "$end" ]; then
            echo "$message within $bound s" >&2
            tail -n 5 /var/log/dockerd.log >&2 || true
            return 1
        fi
        sleep 0.05
    done
}
engine_listens() { [ -S /run/docker.sock ] && docker version; }
containerd_listens() { [ -S /run/containerd/containerd.sock ] && ctr version; }
engine_is_gone() { [ ! -e "/proc/$engine/stat" ]; }
ssh_listens() { [ -n "$(ss -Hltn 'sport = :22')" ]; }

start_docker() {
    # On cgroup v1 the machine's tree is shared: what the inner engine makes stands below a name of ours, to be found again.
    set -- --log-level warn --storage-driver overlay2
    if [ -s /var/lib/rig-cgroup ]; then set -- "$@" --cgroup-parent "$(cat /var/lib/rig-cgroup)"; fi
    rm -f /run/docker.pid
    # Forked away: their parent is to be the reaper, not this script. As on a real host, containerd is a service of its
    # own; dockerd would wait only 15 s for one that it starts itself.
    if ! containerd_listens >/dev/null 2>&1; then
        setsid --fork containerd --log-level warn >>/var/log/containerd.log 2>&1 </dev/null
        until_true 'containerd does not answer' containerd_listens
    fi
    setsid --fork dockerd "$@" >>/var/log/dockerd.log 2>&1 </dev/null
}

stop_docker() {
    [ -s /run/docker.pid ] || return 0
    engine=$(cat /run/docker.pid)
    kill "$engine" 2>/dev/null || return 0
    until_true 'dockerd does not stop' engine_is_gone
}

up() {
    echo "${1:-}" >/var/lib/rig-cgroup
    if [ -z "${1:-}" ]; then
        # cgroup v2, a tree of our own: controllers are handed on only by a group without processes.
        mount -o remount,rw /sys/fs/cgroup
        mkdir -p /sys/fs/cgroup/init
        while read -r pid; do echo "$pid" >/sys/fs/cgroup/init/cgroup.procs 2>/dev/null || true; done </sys/fs/cgroup/cgroup.procs
        sed 's/[^ ]*/+&/g' /sys/fs/cgroup/cgroup.controllers >/sys/fs/cgroup/cgroup.subtree_control
    fi
    # Cuts are made where packets come in: a packet dropped on its way out is an error that its sender sees.
    iptables --wait -t raw -N RIG
    iptables --wait -t raw -I PREROUTING -j RIG
    for type in ed25519 ecdsa; do ssh-keygen -q -N '' -t "$type" -f "/etc/ssh/ssh_host_${type}_key"; done
    # Smaller than the default, which takes a busy machine half a minute.
    ssh-keygen -q -N '' -t rsa -b 2048 -f /etc/ssh/ssh_host_rsa_key
    mkdir -p /run/sshd
    /usr/sbin/sshd -E /var/log/sshd.log
    start_docker
    exec sleep infinity
}

ready() {
    until_true 'sshd does not listen' ssh_listens
    until_true 'dockerd does not answer' engine_listens
}

# Inner containers go first: their cgroups would stay behind on the machine.
down() {
    if engine_listens >/dev/null 2>&1; then docker ps -aq | xargs -r docker rm -f >/dev/null; fi
    stop_docker
}

case $1 in
up) up "${2:-}" ;;
ready) ready ;;
start-docker) start_docker && ready ;;
stop-docker) stop_docker ;;
down) down ;;
*) echo "host.sh: $1?" >&2 && exit 64 ;;
esac
