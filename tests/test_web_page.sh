#!/bin/sh
# tests/test_web_page.sh - the page in a real browser, over rigsim's cameras. Prints TAP; without a Chromium there is nothing to test with.
# BIN: where the programs are. PICTURES=DIR: leave pictures of the page there.
exec perl -Itests/browser tests/browser/page.pl
