# $0 is the folder, the rest is what it is to hold; a lab's own folder or one of something else is not ours to change
set -eu
umask 077
folder=$0
if [ -e "$folder" ]; then
    for each in $(ls -A "$folder"); do
        case $each in
            ca.key) echo "$folder is the lab's own folder: say in the file where certificates may go, such as \
lab = \"zenpark-lab\"" >&2; exit 3;;
            *.pem|*.key|.incoming) ;;
            *) echo "$folder holds something else ($each): say in the file where certificates may go, such as \
lab = \"zenpark-lab\"" >&2; exit 3;;
        esac
    done
fi
mkdir -p "$folder"
chmod 700 "$folder"
rm -rf "$folder/.incoming"
mkdir "$folder/.incoming"
if ! errors=$(tar -xzf - -C "$folder/.incoming" 2>&1); then
    rm -rf "$folder/.incoming"
    echo "$folder cannot be written: $(echo "$errors" | head -n 1); make room there, or choose another place" >&2; exit 3
fi
cd "$folder"
for each in *.pem *.key; do
    if [ -e "$each" ] && [ ! -e ".incoming/$each" ]; then
        rm -f "$each"
        echo "$each"
    fi
done
for each in "$@"; do
    mv ".incoming/$each" "$each"
done
rmdir .incoming
