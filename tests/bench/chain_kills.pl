#!/usr/bin/perl
# tests/bench/chain_kills.pl [KILLS [ROUNDS]] - kill -9 of any process at any stage of the chain, and what becomes of the take.
#
# Each round is a fresh rig of the real programs: rigsim's cameras before a small synthetic studio, rigd, an operator who shoots a panorama
# and two takes with rigctl - the second while the first is developed and solved - and waits until they are solved. Meanwhile KILLS processes in all (60) are killed: rigd, a worker, any program of the
# chain, the keeper between rigd and a program, the operator's rigctl, several at once, all at once. rigd is started again each time.
# In the end, in every round (20):
#  - each take is solved, or says what is missing, and rigctl process then brings it there;
#  - each frame in a take is what its ledger and its manifest say, and what the card holds (gphoto2); none is lost, none is there twice;
#  - each product is what the programs make of the same input when nobody disturbs them, byte for byte but for times;
#  - nothing half is under a final name or left over, no process is left behind, and none worked on beside its successor.
# Environment: BIN (build/bin), SEED (1), STOPS of the panorama head ("0,0; 180,0"), TAKES (2), KEEP=1 keeps all folders, KEEP_BAD=DIR those of rounds
# that went wrong, TARGETS="rigd-develop,all" what is killed in each round, in this order (random), VERBOSE=1 tells each kill. Without gphoto2 the cards are not looked at. Exit 1: one of these is not so.
use strict;
use warnings;
use Cwd qw(abs_path);
use Digest::MD5;
use Fcntl;
use File::Temp qw(tempdir);
use JSON::PP;
use List::Util qw(max min sum0);
use POSIX qw(:sys_wait_h);
use Time::HiRes qw(sleep time);

$| = 1;
my $BIN = abs_path($ENV{BIN} // 'build/bin') // die "no build/bin: run make first\n";
my $CONFIG = abs_path('config/cameras') // die "run from the repository root\n";
my ($N_KILLS, $N_ROUNDS) = (shift // 60, shift // 20);
my $SEED = $ENV{SEED} // 1;
my $CAMERAS = 6; # and one on the panorama head
my $OPTIONS = '--texture 16 --lights 16 --sub-lights 1 --material-lights 64 --bounces 0 --hold-out every:6';
my $STOPS = $ENV{STOPS} // '0,0; 180,0'; # of the panorama head
my @TAKES = (qw(vase bowl))[0 .. ($ENV{TAKES} // 2) - 1];
my $ROUND_S = 900; # longer, and it hangs
my $address = sprintf '127.%d.%d.%d', 1 + ($$ >> 16 & 127), $$ >> 8 & 255, $$ & 255; # tests/loopback.h
my $home = tempdir('studiorig-bench-XXXXXX', DIR => -w '/dev/shm' ? '/dev/shm' : $ENV{TMPDIR} // '/tmp', CLEANUP => !$ENV{KEEP});
my $HAS_GPHOTO2 = system('command -v gphoto2 >/dev/null') == 0;
my %children;
my $main = $$;
END { if ($$ == $main) { my $s = $?; kill 'KILL', keys %children; waitpid $_, 0 for keys %children; $? = $s } }
$SIG{INT} = $SIG{TERM} = sub { exit 2 };

sub slurp { my ($path) = @_; open(my $f, '<:raw', $path) or return; local $/; scalar <$f> }
sub spew { my ($path, $text) = @_; open(my $f, '>:raw', $path) or die "$path: $!"; print $f $text; close $f }
sub md5 { Digest::MD5::md5_hex(slurp($_[0]) // '') }
sub read_json { my $text = slurp($_[0]); defined $text ? eval { decode_json($text) } : undef }

sub launch {
    my ($log, @command) = @_;
    my $pid = fork // die "fork: $!";
    if (!$pid) {
        open(STDOUT, '>>', $log) && open(STDERR, '>>&', \*STDOUT) or POSIX::_exit(126);
        exec @command or POSIX::_exit(127);
    }
    $children{$pid} = 1;
    return $pid;
}
sub reap { my ($pid) = @_; waitpid $pid, 0; delete $children{$pid} }
sub quietly { my ($log, @command) = @_; my $pid = launch($log, @command); reap($pid); return $? >> 8 }

# ---- processes -----------------------------------------------------------------------------------------------------------------

sub stat_of { my $s = slurp("/proc/$_[0]/stat") // return; $s =~ /^\d+ \((.*)\) (\S) (?:\S+ ){18}(\d+)/s ? ($1, $2, $3) : () } # name, state, start
sub descendants { my @found = map { split ' ', slurp($_) // '' } glob "/proc/$_[0]/task/*/children"; return map { ($_, descendants($_)) } @found }
sub is_alive { my ($pid, $start) = @_; my (undef, $state, $began) = stat_of($pid); defined $state && $state ne 'Z' && (!defined $start || $began == $start) }

# The chain's processes: [pid, name]
sub chain { my ($rigd) = @_; return grep { defined $_->[1] } map { [$_, (stat_of($_))[0]] } $rigd, descendants($rigd) }
sub is_program { $_[0] =~ /^(rigd-develop|rigd-panorama|rigd-contact|rigsolve|hook)$/ }

# ---- one rig -------------------------------------------------------------------------------------------------------------------

my $studio = "$home/studio";
quietly("$home/synth.log", "$BIN/rigsolve", qw(synth D3 -o), $studio, qw(--size 128x96 --views), $CAMERAS, qw(--true-lights 64 --panorama-width 128 --seed 1 --samples 1)) == 0 or die slurp("$home/synth.log");
mkdir "$home/$_" for qw(scene fixed fixed/cameras);
my @names = map { sprintf 'A%02d', $_ } 1 .. $CAMERAS;
my @views = sort map { m{([^/]+)\.exr$} } glob "$studio/linear/*.exr";
symlink "$studio/linear/$views[$_].exr", "$home/scene/$names[$_].exr" for 0 .. $#names;
system("cp $studio/geometry/mesh.* $studio/start.json $home/fixed/ && cp $studio/geometry/cameras/*.txt $home/fixed/cameras/") == 0 or die;
my $images = slurp("$studio/geometry/cameras/images.txt");
$images =~ s/\b\Q$views[$_]\E\.\w+/$names[$_].exr/g for 0 .. $#names;
spew("$home/fixed/cameras/images.txt", $images);
# A tool that takes its time and writes by halves; every other round has a fixed rig instead.
spew("$home/hook", "#!/bin/sh\nset -e\nm=\$(ls $home/fixed/mesh.*)\nhead -c 2000 \$m >\$1/geometry/\${m##*/}\nsleep .4\ncp \$m \$1/geometry/\nmkdir -p \$1/geometry/cameras\nsleep .2\n"
    . "cp $home/fixed/cameras/*.txt \$1/geometry/cameras/\ncp $home/fixed/start.json \$1/\n");
chmod 0755, "$home/hook";

sub new_rig {
    my ($round) = @_;
    my $d = "$home/$round";
    mkdir $d;
    mkdir "$d/takes";
    my $r = { dir => $d, takes => "$d/takes" };
    $ENV{RIGD_SOCKET} = "$d/s";
    my @sim = ("$BIN/rigsim", '--cameras', $CAMERAS + 1, '--address', $address, qw(--personality nikon --raw-size 128x96 --seed), $SEED, '--scene', "$home/scene", '--panorama', "$studio/panorama.exr",
        qw(--panorama-gain 0.0625 --trigger-socket), "$d/wires");
    my $list = do { open(my $p, '-|', @sim, '--list') or die; local $/; <$p> };
    $list =~ s/^\[panorama\]\n/$&neutral_density_ev = 4\nstops = $STOPS\nmeter = 1\/60\nlongest = 1\/30\nsettle_ms = 50\n/m;
    $list =~ s/^address = .*\n/$&half_press_ms = 60\nhold_ms = 100\n/m;
    my $geometry = $round % 2 ? "command = $home/hook" : "calibrated = $home/fixed";
    spew("$d/rigd.conf", "[rig]\nname = kills\ntakes = $d/takes\nstate = $d/state\nsocket = $d/s\npersonality_dir = $CONFIG\nraw_mb = 1\nfree_space_mb = 1\ncollect_timeout_ms = 3000\n"
        . "[settings]\nimageformat = raw\niso = 100\naperture = 8\nshutter = 1/60\n[develop]\nafter = on\n[reconstruct]\n$geometry\n[solve]\npreview = on\nthen = standard\nthreads = 2\noptions = $OPTIONS\n$list");
    $r->{sim} = launch("$d/sim.log", @sim);
    for (my $end = time + 120; !-S "$d/wires"; sleep .02) {
        die "rigsim ended: " . slurp("$d/sim.log") if waitpid($r->{sim}, WNOHANG);
        die "rigsim is not there after two minutes\n" if time > $end;
    }
    start_rigd($r);
    return $r;
}
sub start_rigd { my ($r) = @_; $r->{rigd} = launch("$r->{dir}/rigd.log", "$BIN/rigd", '--config', "$r->{dir}/rigd.conf") }

# ---- the operator: does what the README says --------------------------------------------------------------------------------------

sub ledger { my ($take) = @_; read_json("$take/take.json") // {} }
sub newest { my ($r, $name) = @_; my @t = sort glob "$r->{takes}/*_$name"; $t[-1] }
sub is_here { ($_[0]{state} // '') =~ /^(verified|developed|solved)$/ }

# What the take has not; "": it has all.
sub lacks {
    my ($take) = @_;
    my $l = ledger($take);
    my @want = ($l->{kind} // '') eq 'panorama' ? 'panorama.exr' : ((map { "linear/$_.exr" } @names), 'panorama.exr', (map { "geometry/$_" } 'mesh.obj', 'cameras/images.txt'), 'sheet/thumbnails.png', 'sheet/linear.png',
        map { ("solve/$_/report.json", "solve/$_/model.glb", "solve/$_/albedo.exr") } qw(preview standard));
    push my @lacks, grep { !-s "$take/$_" } @want;
    push @lacks, "state $l->{state}" if ($l->{kind} // '') ne 'panorama' && ($l->{state} // '') ne 'solved';
    return join ' ', @lacks;
}

sub operate {
    my ($r, $result) = @_;
    my %o = (reasons => [], said => [], processed => 0, resumed => 0);
    my $end = time + $ROUND_S;
    my $rigctl = sub { quietly("$r->{dir}/rigctl.log", "$BIN/rigctl", @_) };
    my $ready = sub {
        for (; time < $end; sleep .1) {
            my $text = `$BIN/rigctl --json status 2>/dev/null`;
            my $s = eval { decode_json($text) } or next;
            $s = $s->{result} // $s;
            for my $c (grep { $_->{condition} eq 'quarantined' } @{ $s->{cameras} }) { $o{reinstated}++; $rigctl->('reinstate', $c->{name}) }
            return 1 if $s->{n_ready} == $CAMERAS + 1 && !$s->{busy} && !grep { (ledger($_)->{state} // '') =~ /armed|exposing|collecting/ } glob "$r->{takes}/*";
        }
        return 0;
    };
    for my $what (['lights', 'panorama'], map { [$_, 'capture'] } @TAKES) {
        my %resumed;
        while ($ready->()) {
            my $take = newest($r, $what->[0]);
            my $l = $take ? ledger($take) : {};
            last if is_here($l);
            if ($take && $l->{state} && $l->{state} eq 'failed' && !$resumed{$take}++) {
                push @{ $o{reasons} }, $l->{reason};
                $o{resumed}++;
                $rigctl->('resume', $take =~ s{.*/}{}r);
                next;
            }
            $rigctl->($what->[1], '--name', $what->[0]);
        }
    }
    my $watch = launch("$r->{dir}/watch.log", "$BIN/rigctl", 'events');
    for my $name ('lights', @TAKES) {
        my $take = newest($r, $name) // next;
        my $settled = sub { for (; time < $end; sleep .1) { return 1 if (ledger($take)->{processing}{state} // '') =~ /settled|cancelled/ } return 0 };
        while ($settled->() && lacks($take) && $o{processed}++ < 4) {
            push @{ $o{said} }, join('; ', @{ ledger($take)->{processing}{notes} // [] }) || 'NOTHING (lacks ' . lacks($take) . ')';
            $rigctl->('process', $take =~ s{.*/}{}r, '--watch');
        }
    }
    kill 'TERM', $watch;
    reap($watch);
    $o{in_time} = time < $end ? 1 : 0;
    spew($result, encode_json(\%o));
}

# ---- the killer --------------------------------------------------------------------------------------------------------------------

my %lasts_s = ('rigd-unpack' => .01, 'rigd-develop' => .05, 'rigd-panorama' => .1, 'rigd-contact' => .05, rigsolve => .8, hook => .6, 'rigd-keeper' => .3);
my @targets = ((map { ($_) x 4 } 'rigd'), (map { ($_) x 2 } qw(rigd-camera rigd-unpack rigd-develop rigd-panorama rigsolve rigd-keeper several all)), ('rigsolve', 'rigd while solving', 'rigd while solving'), qw(rigd-contact hook rigctl));
my %table; # {target}{stage} => n

# What is going on: of the processing, else of the rig.
sub stage {
    my ($r) = @_;
    my %running = map { $_->[1] => $_->[0] } chain($r->{rigd});
    for my $name (reverse('lights', @TAKES)) {
        my $state = ledger(newest($r, $name) // next)->{state} // next;
        return ($name eq 'lights' ? 'panorama' : 'take') . (grep({ is_program($_) } keys %running) ? ', work paused' : '') if $state =~ /preflight|armed|exposing|collecting/;
        last;
    }
    if ($running{rigsolve}) { return (slurp("/proc/$running{rigsolve}/cmdline") // '') =~ /preview/ ? 'preview' : 'standard' }
    return 'reconstruct' if $running{hook};
    return 'merge' if $running{'rigd-panorama'};
    return 'develop' if $running{'rigd-develop'};
    return 'sheet' if $running{'rigd-contact'};
    return 'between';
}

sub victims { # of a target: pids, or none as yet
    my ($r, $target) = @_;
    return $r->{rigd} if $target eq 'rigd';
    my @chain = chain($r->{rigd});
    return map { $_->[0] } @chain if $target eq 'all';
    return grep { defined } $r->{rigd}, (map { $_->[0] } grep { rand() < .5 } @chain) if $target eq 'several';
    return (grep { $_->[1] eq 'rigsolve' } @chain) ? $r->{rigd} : () if $target eq 'rigd while solving';
    my @of = map { $_->[0] } grep { $_->[1] eq $target } $target eq 'rigctl' ? map { [$_, (stat_of($_))[0] // ''] } descendants($r->{operator}) : @chain;
    return @of ? $of[rand @of] : ();
}

my @old; # programs of a rigd that is dead
sub look_for_overlap {
    my ($r, $complain) = @_;
    @old = grep { is_alive($_->[0], $_->[2]) } @old or return;
    my ($new) = grep { is_program($_->[1]) } chain($r->{rigd}) or return;
    my @still = grep { is_alive($_->[0], $_->[2]) } @old or return; # looked at again: after the new one was seen
    $complain->("$still[0][1] of a rigd that is dead runs beside $new->[1] of the new one");
    @old = ();
}

sub one_round {
    my ($round, $n_kills) = @_;
    my (@complaints, $n);
    my $complain = sub { push @complaints, "round $round: @_"; print "  $complaints[-1]\n" };
    my $r = new_rig($round);
    my $began = time;
    $r->{operator} = fork // die;
    if (!$r->{operator}) { %children = (); operate($r, "$r->{dir}/operator.json"); kill 'KILL', keys %children; POSIX::_exit(0) }
    $children{ $r->{operator} } = 1;
    my $is_over = sub { -e "$r->{dir}/operator.json" };
    my $step = sub { # a moment passes
        sleep .004;
        look_for_overlap($r, $complain);
        if (waitpid($r->{rigd}, WNOHANG)) { # by itself
            delete $children{ $r->{rigd} };
            $complain->('rigd ended by itself, status ' . $?);
            start_rigd($r);
        }
    };
    KILL: for ($n = 0; $n < $n_kills && !$is_over->(); $n++) {
        my $target = $ENV{TARGETS} ? (split /,/, $ENV{TARGETS})[$n] // last : $targets[rand @targets];
        my $at = time + ($lasts_s{$target} || $target eq 'rigd while solving' ? 0 : rand(18 / max(1, $n_kills)));
        my $give_up = time + 20;
        while (time < $at) { $step->(); last KILL if $is_over->() }
        my @victims;
        until (@victims = victims($r, $target)) {
            $step->();
            last KILL if $is_over->();
            next KILL if time > $give_up && $n--;
        }
        if (my $s = $lasts_s{$target} // ($target eq 'rigd while solving' ? $lasts_s{rigsolve} : 0)) {
            for ($at = time + rand($s); time < $at;) { $step->() }
            @victims = grep { is_alive($_) } @victims or redo;
        }
        my $stage = stage($r);
        my @tree = map { [$_->[0], $_->[1], (stat_of($_->[0]))[2]] } grep { is_program($_->[1]) } chain($r->{rigd});
        my $with_rigd = grep { $_ == $r->{rigd} } @victims;
        kill 'KILL', @victims;
        printf "  %5.1f s: %s (%d), %s\n", time - $began, $target, scalar @victims, $stage if $ENV{VERBOSE};
        $table{$target}{$stage}++;
        if ($with_rigd) {
            push @old, @tree;
            reap($r->{rigd});
            start_rigd($r);
        }
    }
    for (; !$is_over->(); $step->()) { }
    my $took = time - $began;
    reap($r->{operator});
    my $o = read_json("$r->{dir}/operator.json");
    $complain->("not done in $ROUND_S s") if !$o->{in_time};
    $complain->("it lacked something and did not say what: $_") for grep { /NOTHING/ || !length } @{ $o->{said} };
    $complain->('a take failed without a reason') for grep { !length($_ // '') } @{ $o->{reasons} };
    audit($r, $complain);
    my $state = join ' ', map { ledger($_)->{state} // '?' } sort glob "$r->{takes}/*";
    printf "round %d: %d kills, %.0f s: %s%s%s%s\n", $round, $n, $took, $state, @{ $o->{reasons} } ? "; failed first: @{$o->{reasons}}" : '', @{ $o->{said} } ? '; it said: ' . join(' | ', @{ $o->{said} }) : '',
        $o->{reinstated} ? "; $o->{reinstated} cameras reinstated" : '';
    system('rm', '-rf', $r->{dir}) if !$ENV{KEEP} && !@complaints;
    system('cp', '-r', $r->{dir}, $ENV{KEEP_BAD}) if $ENV{KEEP_BAD} && @complaints;
    return { kills => $n, complaints => \@complaints, said => scalar @{ $o->{said} }, failed => scalar @{ $o->{reasons} }, seconds => $took };
}

# ---- the audit ---------------------------------------------------------------------------------------------------------------------

my %made; # what undisturbed programs make of these inputs: folder by digest
sub without_times { my ($text, @paths) = @_; $text =~ s/\Q$_\E/TAKE/g for @paths; $text =~ s/"(wall_s|cpu_s|peak_rss_bytes)":\s*[-0-9.e+]+//g; return $text }

sub audit {
    my ($r, $complain) = @_;
    my %content;
    for my $take (sort glob "$r->{takes}/*") {
        my $id = $take =~ s{.*/}{}r;
        my $l = ledger($take);
        $l->{state} or do { $complain->("$id: take.json cannot be read"); next };
        $complain->("$id is $l->{state}") if $l->{state} =~ /armed|exposing|collecting|idle|preflight/;
        my $raw = $l->{kind} && $l->{kind} eq 'panorama' ? 'panorama/raw' : 'raw';
        my %noted;
        for my $c (@{ $l->{cameras} }) {
            for my $f (grep { $_->{state} =~ /copied|deleted/ } @{ $c->{objects} // [] }) {
                my $camera = $raw eq 'raw' ? $c->{name} : 'P';
                $noted{ $f->{file} } = 1;
                $complain->("$id: $f->{file} has other bytes than its ledger says") if (-s "$take/$f->{file}" // -1) != $f->{size};
                $complain->("$camera $f->{folder}/$f->{name} is in two takes") if $content{"$camera $f->{name}"};
                $content{"$camera $f->{name}"} = "$take/$f->{file}";
            }
        }
        for my $f (map { s{^\Q$take\E/}{}r } glob "$take/$raw/*") { $complain->("$id: $f is not in its ledger") if !$noted{$f} }
        next if !is_here($l);
        $complain->("$id has " . keys(%noted) . ' frames') if $raw eq 'raw' && keys %noted != $CAMERAS;
        quietly("$r->{dir}/export.log", "$BIN/rigctl", 'export', $id) == 0 or $complain->("$id: its manifest does not verify: " . slurp("$r->{dir}/export.log"));
    }
    kill 'TERM', $r->{rigd};
    reap($r->{rigd});
    chomp(my @left = `find $r->{takes} -name '*.part' -o -name '.?*' ! -name '.processing.lock' -o -name '*.damaged'`);
    $complain->("left over: $_") for @left;
    for my $take (map { newest($r, $_) // () } 'lights', @TAKES) {
        if (my $lacks = lacks($take)) { $complain->("$take lacks $lacks") }
        compare_products($r, $take, $complain);
        for my $file (split /\n/, `find $take -name '*.json'`) { $complain->("$file is no JSON") if !read_json($file) }
        for my $file (glob "$take/sheet/*.png") { $complain->("$file is not whole") if slurp($file) !~ /\A\x89PNG.*IEND....\z/s }
    }
    # the cards, by the stock client
    my $n = 0;
    for my $i ($HAS_GPHOTO2 ? 0 .. $CAMERAS : ()) {
        my $name = $names[$i] // 'P';
        my $out = "$r->{dir}/cards/$name";
        system('mkdir', '-p', $out);
        local $ENV{HOME} = $out;
        my $p = 15740 + 2 * $i;
        system("cd $out && gphoto2 --quiet --port ptpip:$address:$p:" . ($p + 1) . " --get-all-files --force-overwrite --filename '%f.%C' >$r->{dir}/gphoto.log 2>&1");
        for my $path (glob "$out/*.*") {
            my ($stem) = $path =~ m{([^/]+)\.[^.]+$};
            my ($key) = grep { /^\Q$name $stem\E\./ } keys %content;
            $n++;
            if (!$key) { $complain->("$stem is on the card of $name and in no take: lost") }
            elsif (md5($path) ne md5(delete $content{$key})) { $complain->("$key differs from the card") }
        }
    }
    $complain->("$_ is in a take and not on its card") for $HAS_GPHOTO2 ? keys %content : ();
    $complain->("no card could be read") if $HAS_GPHOTO2 && !$n;
    kill 'TERM', $r->{sim};
    reap($r->{sim});
    for (my $end = time + 60; ; sleep .1) { # of this rig, still there?
        my @left = grep { m{/(\d+)/} && $1 != $$ && (slurp($_) // '') =~ /RIGD_SOCKET=\Q$r->{dir}\E\/s\0/ && is_alive($1) } glob '/proc/[0-9]*/environ';
        last if !@left;
        if (time > $end) { $complain->('still running: ' . join ' ', map { m{/(\d+)/}; (stat_of($1))[0] . " ($1)" } @left); last }
    }
}

sub compare_products {
    my ($r, $take, $complain) = @_;
    my $l = ledger($take);
    my $same = sub { my ($here, $there) = @_; $complain->("$here is not what undisturbed programs make") if !-s $here || md5($here) ne md5($there) };
    my $out = "$r->{dir}/again-" . $take =~ s{.*/}{}r;
    my $log = "$r->{dir}/again.log";
    mkdir $out;
    if ($l->{kind} && $l->{kind} eq 'panorama') {
        quietly($log, "$BIN/rigd-panorama", "$take/panorama/panorama.json", '-o', "$out/panorama.exr", '--json') =~ /^[03]$/ or return $complain->("merging again fails: " . slurp($log));
        $same->("$take/panorama.exr", "$out/panorama.exr");
        return;
    }
    $same->("$take/panorama.exr", (newest($r, 'lights') // '') . '/panorama.exr');
    for my $c (@{ $l->{cameras} }) {
        my ($raw) = map { $_->{file} } @{ $c->{objects} // [] } or next;
        quietly($log, "$BIN/rigd-develop", "$take/$raw", "$out/$c->{name}.exr") == 0 or $complain->("developing again fails: " . slurp($log));
        $same->("$take/linear/$c->{name}.exr", "$out/$c->{name}.exr");
    }
    $same->("$take/geometry/mesh.obj", "$home/fixed/mesh.obj");
    $same->("$take/geometry/cameras/$_", "$home/fixed/cameras/$_") for qw(cameras.txt images.txt);
    for my $preset (qw(preview standard)) {
        quietly($log, "$BIN/rigsolve", 'solve', $take, '-o', "$out/$preset", '--preset', $preset, '--threads', 2, split ' ', $OPTIONS) =~ /^[03]$/ or $complain->("solving again fails: " . slurp($log));
        my ($a, $b) = map { without_times(slurp("$_/report.json") // '', "$take/solve/.$preset.part", "$out/$preset") } "$take/solve/$preset", "$out/$preset";
        $complain->("$take/solve/$preset/report.json is not what an undisturbed solve says") if !length $a || $a ne $b;
        my @files = map { s{.*/}{}r } glob "$out/$preset/*";
        $complain->("$take/solve/$preset holds other files") if join(' ', @files) ne join ' ', map { s{.*/}{}r } glob "$take/solve/$preset/*";
        $same->("$take/solve/$preset/$_", "$out/$preset/$_") for grep { /exr$|lights|glb/ } @files;
    }
}

# ---- all of them --------------------------------------------------------------------------------------------------------------------

print "no gphoto2 here (apt-get install gphoto2): the cards are not looked at\n" if !$HAS_GPHOTO2;
srand $SEED;
my ($killed, @rounds) = 0;
for my $round (1 .. $N_ROUNDS) {
    my $left = $N_KILLS - $killed;
    my $result = one_round($round, int($left / ($N_ROUNDS - $round + 1) + .5));
    $killed += $result->{kills};
    push @rounds, $result;
}
my %stages = map { $_ => 1 } map { keys %$_ } values %table;
printf "\n%-24s", 'killed';
print "  $_" for sort keys %stages;
print "\n";
for my $target (sort keys %table) { printf "%-24s", $target; printf '  %' . length($_) . 's', $table{$target}{$_} // '' for sort keys %stages; print "\n" }
my @complaints = map { @{ $_->{complaints} } } @rounds;
printf "\n%d kills in %d rounds (seed %d): %d rounds ended complete by themselves, %d after saying what was missing (rigctl process), %d with a take that failed and said why (rigctl resume, or shot again)\n", $killed, scalar @rounds,
    $SEED, scalar(grep { !$_->{said} && !$_->{failed} } @rounds), scalar(grep { $_->{said} } @rounds), scalar(grep { $_->{failed} } @rounds);
printf "a round took %.0f .. %.0f s\n", min(map { $_->{seconds} } @rounds), max(map { $_->{seconds} } @rounds);
print @complaints ? "BROKEN: " . @complaints . " complaints, above\n" : "kept: nothing lost, nothing doubled, nothing half, every product as undisturbed\n";
exit(@complaints ? 1 : 0);
