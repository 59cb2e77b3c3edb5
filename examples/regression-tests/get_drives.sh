#!/bin/sh
# Puts the recorded drives where the tests look for them. Yours lie in some storage: copy them from there instead, or
# give their URLs to the tests, such as pcgan_log("s3://bucket/drives/*.mcap").
set -eu
cd "$(dirname "$0")"
mkdir -p tests/drives
pcgan simulate tests/drives/crossing.mcap --pedestrians 8 --duration 10 --seed 7
pcgan simulate tests/drives/crowd.mcap --pedestrians 8 --duration 10 --seed 6
