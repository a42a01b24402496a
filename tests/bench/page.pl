# tests/bench/page.pl [CAMERAS [TAKES]] - from what happens in the rig to what a browser shows, in milliseconds.
#   perl -Itests/browser tests/bench/page.pl 6 20
# states: from the moment rigd tells a client on its socket to the page's text. A worker that is killed: from the kill (rigd has to
# notice it) to the page's message. Also what an open page costs rigd in processor time, idle.
use strict;
use warnings;
use Browser;
use Rig;
use File::Temp ();
use IO::Socket::UNIX;
use JSON::PP;
use List::Util qw(max);
use Time::HiRes qw(time sleep);

my ($n_cameras, $n_takes) = (shift // 6, shift // 20);
my $rig = Rig->new($n_cameras);
$rig->start;
my $page;
sub load { # of rigd, while nothing happens but heartbeats
    my ($cpu, $began) = (processor_s(), time);
    sleep 26; # a heartbeat at least
    return 100 * (processor_s() - $cpu) / (time - $began);
}
$page = Browser->open($rig->url, File::Temp::tempdir(CLEANUP => 1));
$page->until_true("document.querySelectorAll('#cameras li.ready').length === $n_cameras", 90) or die "the cameras did not come up\n";

sub processor_s { my $ns = 0; for (glob "/proc/$rig->{rigd}/task/*/schedstat") { open my $f, '<', $_ or next; $ns += (split ' ', <$f>)[0] } return 1e-9 * $ns } # ticks miss short work
my $with = load();
$page->go('about:blank');
sleep 1;
printf "idle, %d cameras: rigd takes %.2f %% of a core, %.2f %% with a page open\n", $n_cameras, load(), $with;
$page->go($rig->url);
$page->until_true("document.querySelectorAll('#cameras li.ready').length === $n_cameras", 20) or die "the page did not come back\n";

$page->js('window.seen = []; window.last = {};'
    . 'new MutationObserver(() => { const t = document.querySelector("#state").textContent.replace(/^.*?: /, "").replace(/[,.].*/, "").toLowerCase(); if (!document.querySelector("#now").hidden && t !== last.state) { last.state = t; seen.push([Date.now() / 1000, "state", t]) } })'
    . '.observe(document.querySelector("#now"), { subtree: true, childList: true, characterData: true, attributes: true });'
    . 'new MutationObserver(() => { const t = document.querySelector("#outcome").textContent; if (t) seen.push([Date.now() / 1000, "state", (t.match(/: (\\w+)/) || [])[1]]) }).observe(document.querySelector("#outcome"), { childList: true });'
    . 'new MutationObserver(() => { const t = document.querySelector("#log li").textContent; seen.push([Date.now() / 1000, "said", (t.match(/camera (\\w+)/) || [])[1]]) }).observe(document.querySelector("#log"), { childList: true })');
my $socket = IO::Socket::UNIX->new("$rig->{dir}/s") or die $!;
syswrite $socket, qq({"id":1,"do":"subscribe"}\n);
my ($buffer, @told) = ('');
sub listen_for { # until a line matches, or so many seconds
    my ($what, $seconds) = @_;
    my $end = time + $seconds;
    while (time < $end) {
        vec(my $bits = '', fileno $socket, 1) = 1;
        next unless select($bits, undef, undef, .05);
        sysread $socket, $buffer, 1 << 16, length $buffer or return 0;
        my $now = time;
        while ($buffer =~ s/^(.*)\n//) {
            my $line = $1;
            push @told, [ $now, $1 ] if $line =~ /"event":"state".*"state":"(\w+)"/;
            return 1 if $line =~ $what;
        }
    }
    return 0;
}
my %delay;
for my $k (1 .. $n_takes) {
    @told = ();
    $page->js('seen = []; last.state = ""; document.querySelector("#name").value = "t"');
    $page->until_true('!document.querySelector("#capture").disabled', 30) or die "not armed\n";
    syswrite $socket, qq({"id":2,"do":"capture","name":"t"}\n);
    listen_for(qr/"id":2/, 60);
    sleep .4;
    my %shown = map { $_->[1] eq 'state' ? ($_->[2] => $_->[0]) : () } @{ $page->js('seen') };
    for (@told) { push @{ $delay{ 'state ' . $_->[1] } }, defined $shown{ $_->[1] } ? 1e3 * ($shown{ $_->[1] } - $_->[0]) : undef }
}
for my $k (1 .. $n_takes) { # a worker dies
    my ($pid, $name) = split ' ', (split /\n/, `pgrep -P $rig->{rigd} -a -f '^rigd-camera' | sed 's/rigd-camera //'`)[ $k % $n_cameras ];
    $page->js('seen = []');
    sleep 1;
    my $t = time;
    kill 'KILL', $pid;
    my $changed = $page->until_true("seen.some(s => s[2] === '$name')", 5);
    push @{ $delay{'killed worker'} }, $changed ? 1e3 * ($page->js("seen.find(s => s[2] === '$name')[0]") - $t) : undef;
    $page->until_true("document.querySelectorAll('#cameras li.ready').length === $n_cameras", 60) or die "it did not come back\n";
}
printf "%-22s %5s %8s %8s %8s %s\n", 'ms from event to page', 'n', 'median', '95 %', 'most', 'never shown';
for my $what (sort keys %delay) {
    my @d = sort { $a <=> $b } grep { defined } @{ $delay{$what} };
    my $missed = @{ $delay{$what} } - @d;
    printf "%-22s %5d %8.1f %8.1f %8.1f %d\n", $what, scalar @d, @d ? ($d[ $#d / 2 ], $d[ $#d * .95 ], max @d) : (0, 0, 0), $missed;
}
