# $0 is the folder, the rest is what to put there; a checkout or a folder of something else is not ours to change
set -eu
folder=$0
if [ -e "$folder/.git" ]; then
    echo "$folder is a git checkout: bring it up to date with git, there" >&2; exit 3
fi
ours() { grep -q '^name = "zenpark"' "$folder/pyproject.toml" 2>/dev/null; }
if [ -d "$folder" ] && [ -n "$(ls -A "$folder")" ] && ! ours; then
    echo "$folder holds something else: say in the file where zenpark may go, such as \"zenpark/zenpark\"" >&2; exit 3
fi
mkdir -p "$folder"
rm -rf "$folder/.incoming"
mkdir "$folder/.incoming"
if ! errors=$(tar -xzf - -C "$folder/.incoming" 2>&1); then
    rm -rf "$folder/.incoming"
    echo "$folder cannot be written: $(echo "$errors" | head -n 1); make room there, or choose another place" >&2; exit 3
fi
for each in "$@"; do
    rm -rf "$folder/$each"
    mv "$folder/.incoming/$each" "$folder/$each"
done
rmdir "$folder/.incoming"
exec "$folder/zenpark" --version
