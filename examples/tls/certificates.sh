#!/bin/sh
# Makes an authority of your own, and a key and a certificate for each machine:
#   certificates.sh FOLDER NAME=ADDRESS...      such as: certificates.sh tls robot=192.168.0.2 base=base.local
# The address is the one that the others connect to. Keep `ca.key` off the robots; copy to each machine its own NAME.key,
# NAME.pem and NAME.json5, and ca.pem.
set -eu
[ $# -ge 2 ] || { sed -n '2,5s/^# \{0,1\}//p' "$0" >&2; exit 2; }
folder=$1; shift
umask 077
mkdir -p "$folder"; cd "$folder"
if [ ! -f ca.pem ]; then
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 -subj "/CN=conicflow authority" \
        -addext "basicConstraints=critical,CA:TRUE" -keyout ca.key -out ca.pem 2>/dev/null
fi
for pair in "$@"; do
    name=${pair%%=*}; address=${pair#*=}
    case $address in *:*) san=IP:$address ;; *[!0-9.]*) san=DNS:$address ;; *) san=IP:$address ;; esac
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$name" -keyout "$name.key" -out "$name.csr" \
        2>/dev/null
    printf 'subjectAltName=%s\nbasicConstraints=CA:FALSE\nextendedKeyUsage=serverAuth,clientAuth\n' "$san" > "$name.ext"
    openssl x509 -req -in "$name.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days 825 -extfile "$name.ext" \
        -out "$name.pem" 2>/dev/null
    rm "$name.csr" "$name.ext"
    cat > "$name.json5" <<EOF
// Both sides show their certificates; files are relative to this one. access_control.json5 says how to name who may do what.
{
    transport: { link: { tls: {
        root_ca_certificate: "ca.pem",
        listen_private_key: "$name.key", listen_certificate: "$name.pem",
        connect_private_key: "$name.key", connect_certificate: "$name.pem",
        enable_mtls: true,
    } } },
}
EOF
done
