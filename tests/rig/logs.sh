# All that explains a failure on this host; run with `docker exec`.
show() {
    printf '\n### %s\n' "$*"
    timeout 20 "$@" 2>&1
}
show date
show ps -efww --forest
show ss -anptux
show ip address
show ip route
show iptables-save
show df -h
show docker ps --all
show docker image ls --all
for container in $(timeout 20 docker ps --all --quiet); do
    show docker inspect "$container"
    show docker logs --timestamps --tail 500 "$container"
done
find /var/log /home /root /run /tmp /var/lib/ictus -xdev -type f \
    \( -name '*.log' -o -name '*.json' -o -path '*/ictus/*' \) -size -4096k ! -name '*.sock' 2>/dev/null |
    while read -r file; do
        # Programs lie beside records: only text is shown.
        if grep -qI . "$file"; then show tail -n 500 "$file"; fi
    done
