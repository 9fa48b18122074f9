# $0 is the folder, $1 the namespace, $2 the domain, $3 the silence [s]; the watchdog comes on standard input
set -eu
folder=$HOME/$0
setup=$(ls -d /opt/ros/*/setup.sh 2>/dev/null | tail -n 1 || true)
[ -n "${ROS_SETUP:-$setup}" ] || { echo "there is no ROS 2 under /opt/ros" >&2; exit 3; }
mkdir -p "$folder"
cat > "$folder/watchdog.py.new"
mv "$folder/watchdog.py.new" "$folder/watchdog.py"
cat > "$folder/run" <<END
#!/bin/sh
# Keeps the watchdog running; started at boot by cron, ended by: touch $folder/stop
exec 9> "$folder/lock"
flock -n 9 || exit 0
rm -f "$folder/stop"
. "${ROS_SETUP:-$setup}"
export ROS_DOMAIN_ID=$2 PYTHONUNBUFFERED=1
while [ ! -e "$folder/stop" ]; do
    python3 "$folder/watchdog.py" --silence $3 --ros-args -r __ns:=/$1 > "$folder/log" 2>&1 9>&- &
    echo \$! > "$folder/pid"
    wait \$! || true
    sleep 1
done
END
chmod +x "$folder/run"
touch "$folder/stop"
[ ! -e "$folder/pid" ] || kill "$(cat "$folder/pid")" 2>/dev/null || true
flock -w 10 "$folder/lock" true || { echo "the former watchdog does not end: see $folder" >&2; exit 4; }
rm -f "$folder/pid" "$folder/log"
nohup "$folder/run" > /dev/null 2>&1 < /dev/null &
if command -v crontab > /dev/null; then
    { crontab -l 2>/dev/null | grep -v "$folder/run" || true; echo "@reboot $folder/run"; } | crontab -
    echo "it is started at each boot (crontab -l)"
else
    echo "there is no cron: start $folder/run at each boot yourself"
fi
for _ in $(seq 150); do
    if grep -q "watches" "$folder/log" 2>/dev/null; then grep "watches" "$folder/log" | tail -n 1; exit 0; fi
    sleep 0.1
done
echo "it does not come up:" >&2; tail -n 5 "$folder/log" >&2; exit 5
