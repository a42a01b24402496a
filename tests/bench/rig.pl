#!/usr/bin/perl
# tests/bench/rig.pl - what the rig promises, measured on the real chain: rigsim's cameras and wires, rigd with its workers.
#   rig.pl kills [N [INSTANCES]]  kill -9 of daemon and workers at random moments; then every card is read by gphoto2 and compared
#   rig.pl scale                  200 cameras: opening, idle, memory; 85 cameras x 8 MB against cp
#   rig.pl faults [PAIRS [WHICH]] one of 12 cameras misbehaves: when is it back or out, what do the others notice
#   rig.pl soak [N]               N takes: descriptors, memory, processes
#   rig.pl lag [SHOTS]            calibration against the wires' truth
#   rig.pl hundred                100 cameras: preflight, settings, status and identify, calibration; and links of known speed
#   rig.pl full                   the disk fills in the middle of a take (a small tmpfs: needs root)
#   rig.pl eio                    the disk fails in the middle of a take
# Environment: BIN (build/bin), TMPDIR (a folder on the disk to be measured; kills and faults prefer /dev/shm), SEED, KEEP=1 keeps
# the folders; ASCMHL="ascmhl-debug verify" lets the reference tool look at 20 manifests, too. Plain Perl, nothing beyond Debian's
# perl; gphoto2 for kills. Exit 1: a promise was broken.
use strict;
use warnings;
use Cwd qw(abs_path);
use Digest::MD5;
use Errno;
use Fcntl;
use File::Temp qw(tempdir);
use IO::Select;
use IO::Socket::UNIX;
use JSON::PP;
use List::Util qw(max min sum shuffle);
use POSIX qw(:sys_wait_h);
use Socket;
use Time::HiRes qw(sleep clock_gettime CLOCK_MONOTONIC);

$| = 1;
my $BIN = abs_path($ENV{BIN} // 'build/bin') // die "no build/bin: run make first\n";
my $CONFIG = abs_path('config/cameras') // die "run from the repository root\n";
my $SEED = $ENV{SEED} // 1;
my $broken = 0;
my %children; # pids of ours, killed at the end

sub now { clock_gettime(CLOCK_MONOTONIC) }
sub median { my @s = sort { $a <=> $b } @_; @s ? @s % 2 ? $s[$#s / 2] : ($s[@s / 2 - 1] + $s[@s / 2]) / 2 : undef }
sub promise { my ($kept, $text) = @_; $broken = 1 if !$kept; printf "%s  %s\n", $kept ? 'kept  ' : 'BROKEN', $text }
sub slurp { my ($path) = @_; open(my $f, '<:raw', $path) or return; local $/; scalar <$f> }
sub folder { my ($ram) = @_; tempdir('studiorig-bench-XXXXXX', DIR => $ram && -w '/dev/shm' ? '/dev/shm' : $ENV{TMPDIR} // '/var/tmp', CLEANUP => !$ENV{KEEP}) }

# ---- a rig: rigsim, rigd, and a conversation with it -------------------------------------------------------------------------

sub launch {
    my ($log, %o) = @_;
    my $pid = fork // die "fork: $!";
    if (!$pid) {
        $ENV{$_} = $o{env}{$_} for keys %{$o{env} // {}};
        open(STDOUT, '>>', $log) && open(STDERR, '>>&', \*STDOUT) or POSIX::_exit(126);
        exec @{$o{command}} or POSIX::_exit(127);
    }
    $children{$pid} = 1;
    return $pid;
}

sub end {
    my ($pid, $signal) = @_;
    return if !$pid;
    kill $signal // 'TERM', $pid;
    waitpid $pid, 0;
    delete $children{$pid};
}

# An address of this machine that is nobody else's (tests/loopback.h).
sub address { sprintf '127.%d.%d.%d', 1 + ($$ >> 16 & 127), $$ >> 8 & 255, $$ & 255 }

# cameras, personality, raw (WxH), set [...], faults (text), rig (lines of [rig]), trigger (lines), takes (folder), sections (sub: edits the list)
sub new_rig {
    my (%o) = @_;
    my $r = { %o, dir => $o{dir} // folder($o{ram}), port => $o{port} // 15740 };
    my $d = $r->{dir};
    $r->{takes} //= "$d/takes";
    $r->{personality} //= 'nikon';
    my $faults = $o{faults};
    if (defined $faults) {
        open(my $f, '>', "$d/faults") or die;
        print $f $faults;
    }
    my @sim = ("$BIN/rigsim", '--cameras', $o{cameras}, '--personality', $r->{personality}, '--address', address(), '--port', $r->{port}, '--seed', $o{seed} // $SEED, '--raw-size', $o{raw} // '408x272',
        '--trigger-socket', "$d/wires", (map { ('--set', $_) } @{$o{set} // []}), defined $faults ? ('--faults', "$d/faults") : ());
    my $list = do { open(my $p, '-|', @sim, '--list') or die; local $/; <$p> };
    $list =~ s/^address = .*\n/$&$o{trigger}\n/m if $o{trigger};
    $o{sections}->(\$list) if $o{sections};
    open(my $c, '>', "$d/rigd.conf") or die;
    print $c "[rig]\nname = bench\ntakes = $r->{takes}\nstate = $d/state\nsocket = $d/s\npersonality_dir = $CONFIG\n", $o{rig} // "raw_mb = 1\nfree_space_mb = 1\n",
        "[settings]\nimageformat = raw\niso = 100\naperture = 8\nshutter = 1/125\n$list";
    close $c;
    $r->{sim_command} = \@sim;
    start_sim($r);
    return $r;
}

sub start_sim {
    my ($r) = @_;
    $r->{sim} = launch("$r->{dir}/sim.log", command => $r->{sim_command});
    my $until = now() + 20;
    while (now() < $until && !-S "$r->{dir}/wires") {
        die "rigsim ended: " . slurp("$r->{dir}/sim.log") if waitpid($r->{sim}, WNOHANG);
        sleep .02;
    }
}

sub start_rigd {
    my ($r) = @_;
    $r->{conversation} = undef;
    $r->{events} = [];
    $r->{answers} = {};
    $r->{rigd_began} = now();
    $r->{rigd} = launch("$r->{dir}/rigd.log", command => ["$BIN/rigd", '--config', "$r->{dir}/rigd.conf"], env => $r->{env});
}

# Connected and subscribed? Tries once.
sub connected {
    my ($r) = @_;
    return 1 if $r->{conversation};
    my $s = IO::Socket::UNIX->new(Peer => "$r->{dir}/s") or return 0;
    $s->blocking(0);
    $r->{conversation} = $s;
    $r->{bytes} = '';
    $r->{answers} = {};
    ask($r, 'subscribe');
    return 1;
}

sub ask { # -> id
    my ($r, $do, %with) = @_;
    my $id = ++$r->{id};
    my $line = encode_json({ v => 1, id => $id, do => $do, %with }) . "\n";
    local $SIG{PIPE} = 'IGNORE';
    $r->{conversation} = undef if !defined syswrite($r->{conversation}, $line);
    return $id;
}

# What it says within so many seconds: answers into {answers}, events (with the time of arrival) into {events}.
sub listen_for {
    my ($r, $seconds, $until) = @_;
    my $end = now() + $seconds;
    for (;;) {
        return 1 if $until && $until->();
        my $left = $end - now();
        return 0 if $left <= 0;
        if (!connected($r)) { sleep min($left, .01); next }
        my ($ready) = IO::Select->new($r->{conversation})->can_read(min($left, .1));
        next if !$ready;
        my $n = sysread($r->{conversation}, $r->{bytes}, 1 << 20, length $r->{bytes});
        next if !defined $n && $!{EAGAIN};
        if (!$n) { $r->{conversation} = undef; return 0 if $r->{ends_with_daemon}; next }
        while ($r->{bytes} =~ s/^([^\n]*)\n//) {
            my $m = decode_json($1);
            if (defined $m->{event}) { push @{$r->{events}}, { %$m, at => now() }; $r->{heard}->($m) if $r->{heard} }
            else { $r->{answers}{$m->{id}} = $m }
        }
    }
}

sub request { # waits for the answer; undef when the daemon left
    my ($r, $do, %with) = @_;
    my $patience = delete $with{patience} // 120;
    listen_for($r, 20, sub { $r->{conversation} });
    return if !connected($r);
    my $id = ask($r, $do, %with);
    listen_for($r, $patience, sub { $r->{answers}{$id} }) or return;
    return delete $r->{answers}{$id};
}

sub ready { # all cameras, nothing under way
    my ($r, $seconds) = @_;
    my $end = now() + ($seconds // 60);
    while (now() < $end) {
        my $s = request($r, 'status', patience => 10);
        return 1 if $s && $s->{ok} && $s->{result}{n_ready} == $r->{cameras} && !$s->{result}{busy} && ($r->{no_trigger} || $s->{result}{trigger} !~ /not/);
        listen_for($r, .05);
    }
    return 0;
}

sub capture { my ($r, %with) = @_; my $a = request($r, 'capture', %with); $a // die "rigd left:\n" . `tail -5 $r->{dir}/rigd.log` }
sub report { my ($r, $id) = @_; request($r, 'report', take => $id)->{result} }
sub workers { my ($r) = @_; split ' ', slurp("/proc/$r->{rigd}/task/$r->{rigd}/children") // '' }
sub stop { my ($r) = @_; end(delete $r->{rigd}); end(delete $r->{sim}) }

# ---- kills ---------------------------------------------------------------------------------------------------------------------

# One rig, killed n times. What the card holds in the end is the truth: gphoto2 reads it, and every frame must be in exactly one take.
sub kill_instance {
    my ($instance, $n, $result) = @_;
    my $cameras = $ENV{CAMERAS} // 6;
    srand($SEED * 1000 + $instance);
    my $r = new_rig(ram => 1, cameras => $cameras, seed => $SEED + $instance, trigger => "half_press_ms = 60\nhold_ms = 100",
        rig => "raw_mb = 1\nfree_space_mb = 1\ncollect_timeout_ms = 3000\n");
    my (%where, $phase, $capturing, $fresh, $resumes, %own);
    $r->{ends_with_daemon} = 1;
    $r->{heard} = sub {
        my ($m) = @_;
        if ($m->{event} eq 'state') {
            my $take = $m->{body}{take};
            if ($m->{body}{state} eq 'preflight') {
                $own{$take} = 1;
                $r->{take_began} = now();
            }
            $phase = $own{$take} ? $m->{body}{state} : 'resume';
        } elsif ($m->{event} eq 'take') {
            $phase = 'idle';
        }
    };
    my $begin = now();
    my $life = sub { start_rigd($r); $phase = 'start'; $capturing = undef; %own = () };
    $life->();
    ready($r) or die "instance $instance does not come up\n";
    my ($k, $n_daemon, $n_worker, $quarantines) = (0, 0, 0, 0);
    while ($k < $n) {
        # one in five at once after the last one, one in five wherever it then is, the others somewhere in the next take
        my $die = rand();
        my $end = now() + ($die < .2 ? rand(.25) : $die < .4 ? rand(2.2) : 20);
        $r->{take_began} = undef;
        my $into = rand(1.5);
        while ((my $left = $end - now()) > 0) {
            listen_for($r, min($left, .05));
            $end = min($end, $r->{take_began} + $into) if $die >= .4 && $r->{take_began};
            if ($capturing && $r->{answers}{$capturing}) { # refused (busy with a resume) or done: again
                my $a = delete $r->{answers}{$capturing};
                $phase = 'resume' if $phase eq 'start' && !$a->{ok} && $a->{error}{code} eq 'busy';
                $capturing = undef;
                listen_for($r, min(max($end - now(), 0), $a->{ok} ? rand(.1) : .05));
            }
            $capturing = ask($r, 'capture', name => "k$k") if $r->{conversation} && !$capturing;
        }
        my @w = workers($r);
        my $worker = rand() < 1 / 3 && @w ? $w[rand @w] : 0;
        $where{$phase}{$worker ? 'worker' : 'daemon'}++;
        kill 'KILL', $worker || $r->{rigd};
        $k++;
        if ($worker) {
            $n_worker++;
        } else {
            $n_daemon++;
            waitpid $r->{rigd}, 0;
            delete $children{$r->{rigd}};
            $quarantines += grep { $_->{event} eq 'say' && $_->{body}{text} =~ /quarantined/ } @{$r->{events}};
            $life->();
        }
        printf STDERR "instance %d: %d kills, %.0f s\n", $instance, $k, now() - $begin if $k % 50 == 0;
    }
    my $killed_s = now() - $begin;
    # Let it finish. A camera that was quarantined is tried again.
    my $end = now() + 180;
    for (;;) {
        my $s = request($r, 'status');
        if ($s) {
            request($r, 'reinstate', camera => $_->{name}) for grep { $_->{condition} eq 'quarantined' } @{$s->{result}{cameras}};
        }
        if (ready($r, 20)) {
            my $takes = request($r, 'takes');
            last if $takes && !grep { $_->{state} =~ /armed|exposing|collecting/ } @{$takes->{result}{takes}};
        }
        last if now() > $end;
    }
    my %account = (kills => $k, daemon => $n_daemon, worker => $n_worker, seconds => $killed_s, where => \%where, quarantines => $quarantines);
    audit($r, \%account);
    stop($r);
    open(my $f, '>', $result) or die;
    print $f encode_json(\%account);
    close $f;
    system('rm', '-rf', $r->{dir}) if !$ENV{KEEP} && !@{$account{complaints}};
    print "instance $instance: see $r->{dir}\n" if @{$account{complaints}};
}

sub md5 { my ($path) = @_; open(my $f, '<:raw', $path) or return ''; Digest::MD5->new->addfile($f)->hexdigest }

# Compare ledgers, folders, manifests and cards.
sub audit {
    my ($r, $account) = @_;
    my (@complaints, %owner, %state, $n_frames, %content, $manifests, %reasons);
    my $complain = sub { push @complaints, shift };
    $n_frames = $manifests = 0;
    for my $t (glob "$r->{takes}/*/") {
        my ($id) = $t =~ m{([^/]+)/$};
        my $l = eval { decode_json(slurp("$t/take.json")) } or do { $complain->("$id: take.json cannot be read"); next };
        $state{$l->{state}}++;
        $reasons{$l->{reason} =~ s/\b[A-Z]\d\d\b.*//r}++ if $l->{state} eq 'failed';
        my %noted;
        for my $c (@{$l->{cameras}}) {
            my @here = grep { $_->{state} eq 'copied' || $_->{state} eq 'deleted' } @{$c->{objects} // []};
            $complain->("$id: $c->{name} has " . @here . " frames, state $l->{state}") if $l->{state} eq 'verified' && @here != 1;
            for my $o (@here) {
                my $path = "$t/$o->{file}";
                $noted{$o->{file}} = $o;
                $n_frames++;
                my $size = -s $path // -1;
                my $said = $o->{size} // $o->{size_bytes} // -2;
                $complain->("$id: $o->{file} has $size bytes, its ledger says $said") if $size != $said;
                my $key = "$c->{name} $o->{folder}/$o->{name}";
                $complain->("$key is in two takes: $owner{$key}, $id") if $owner{$key};
                $owner{$key} = $id;
                $content{$key} = md5($path);
            }
        }
        for my $path (glob "$t/raw/*") {
            my ($file) = $path =~ m{(raw/[^/]+)$};
            $complain->("$id: $file is on disk and not in its ledger") if !$noted{$file};
        }
        # the manifest that the take wrote, against the ledger; then rigd reads every byte again
        if ($l->{state} eq 'verified') {
            my ($first) = glob "$t/ascmhl/0001*.mhl";
            my $text = $first ? slurp($first) : '';
            my %in;
            $in{$1} = $2 while $text =~ m{<path[^>]*>([^<]+)</path>.*?<xxh128[^>]*>([0-9a-f]+)</xxh128>}sg;
            for my $file (keys %noted) {
                $complain->("$id: $file: manifest " . ($in{$file} // 'without it') . ", ledger $noted{$file}{xxh128}") if ($in{$file} // '') ne $noted{$file}{xxh128};
            }
            my $x = request($r, 'export', take => $id);
            $x && $x->{ok} && $x->{result}{intact} ? $manifests++ : $complain->("$id: its manifest does not verify");
            if ($ENV{ASCMHL} && $account->{reference}++ < 20 && system("$ENV{ASCMHL} '$t' >$r->{dir}/reference.log 2>&1")) {
                $complain->("$id: '$ENV{ASCMHL}' finds fault: " . slurp("$r->{dir}/reference.log"));
            }
        }
    }
    chomp(my @parts = `find $r->{takes} -name '*.part*' -o -name '.*' -type f ! -name .processing.lock`);
    $complain->("left over: $_") for @parts;
    # The cards, by the stock client.
    end(delete $r->{rigd});
    my $on_cards = 0;
    my @names = slurp("$r->{dir}/rigd.conf") =~ /\[camera "([^"]+)"\]/g;
    for my $i (0 .. $#names) {
        my $out = "$r->{dir}/cards/$names[$i]";
        system('mkdir', '-p', $out);
        local $ENV{HOME} = $out;
        my $p = $r->{port} + 2 * $i;
        system("cd $out && gphoto2 --quiet --port ptpip:" . address() . ":$p:" . ($p + 1) . " --get-all-files --force-overwrite --filename '%f.%C' >$r->{dir}/gphoto.log 2>&1");
        for my $path (glob "$out/*.*") {
            my ($stem) = $path =~ m{([^/]+)\.[^.]+$};
            $on_cards++;
            my ($key) = grep { $content{$_} } map { "$names[$i] $_" } map { m{ (.*)}s ? $1 : () } grep { /^\Q$names[$i]\E .*\/\Q$stem\E\./ } keys %content;
            if (!$key) { $complain->("$names[$i]: $stem is on its card and in no take: lost") }
            elsif ($content{$key} ne md5($path)) { $complain->("$key: the copy differs from the card") }
            else { delete $content{$key} }
        }
    }
    $complain->("$_ is in a take and not on its card") for keys %content;
    $complain->("no camera's card could be read") if !$on_cards;
    @$account{qw(takes frames on_cards manifests complaints reasons)} = (\%state, $n_frames, $on_cards, $manifests, \@complaints, \%reasons);
}

sub kills {
    my $n = shift // 1000;
    my $instances = shift // 2;
    my $d = folder(1);
    my @pids;
    for my $i (1 .. $instances) {
        my $pid = fork // die;
        if (!$pid) {
            %children = ();
            my $done = eval { kill_instance($i, int($n * $i / $instances) - int($n * ($i - 1) / $instances), "$d/$i"); 1 };
            print "instance $i: $@" if !$done;
            end($_, 'KILL') for keys %children;
            POSIX::_exit(!$done);
        }
        push @pids, $pid;
    }
    waitpid $_, 0 for @pids;
    my (%sum, %where, @complaints, %takes, %reasons);
    for my $i (1 .. $instances) {
        my $a = -e "$d/$i" ? decode_json(slurp("$d/$i")) : { complaints => ["instance $i did not end"] };
        $sum{$_} += $a->{$_} // 0 for qw(kills daemon worker frames on_cards manifests quarantines);
        $sum{seconds} = max($sum{seconds} // 0, $a->{seconds} // 0);
        for my $w (keys %{$a->{where}}) { $where{$w}{$_} += $a->{where}{$w}{$_} for keys %{$a->{where}{$w}} }
        $takes{$_} += $a->{takes}{$_} for keys %{$a->{takes}};
        $reasons{$_} += $a->{reasons}{$_} for keys %{$a->{reasons}};
        push @complaints, @{$a->{complaints}};
    }
    printf "%d kills (%d of the daemon, %d of a worker) in %.0f s, %d rigs\n", @sum{qw(kills daemon worker seconds)}, $instances;
    printf "  %-20s daemon %4d  worker %4d\n", $_, $where{$_}{daemon} // 0, $where{$_}{worker} // 0 for sort keys %where;
    printf "takes: %s\n", join ', ', map { "$takes{$_} $_" } sort keys %takes;
    printf "  %5d failed: %s\n", $reasons{$_}, $_ for sort keys %reasons;
    printf "frames: %d on the cards, %d in takes; %d manifests verified; %d quarantines\n", @sum{qw(on_cards frames manifests quarantines)};
    print "  $_\n" for @complaints > 20 ? (@complaints[0 .. 19], '...') : @complaints;
    promise(!@complaints && $sum{kills} == $n, "$n kills: no frame lost, doubled or half there; ledger, disk, manifest and cards agree");
}

# ---- scale ---------------------------------------------------------------------------------------------------------------------

sub cpu_s { # of a process and its threads so far
    my ($pid) = @_;
    1e-9 * sum(0, map { (slurp($_) // '0') =~ /^(\d+)/ ? $1 : 0 } glob "/proc/$pid/task/*/schedstat");
}

sub private_kb { my ($pid) = @_; my $t = slurp("/proc/$pid/smaps_rollup") // ''; sum(0, $t =~ /^Private_(?:Clean|Dirty): +(\d+)/mg) }

sub scale {
    my $r = new_rig(cameras => 200, rig => "raw_mb = 1\nfree_space_mb = 1\n");
    my @open_s;
    for my $turn (1 .. 3) {
        start_rigd($r);
        my $all = 0;
        while (!$all && now() - $r->{rigd_began} < 60) {
            my $s = request($r, 'status');
            $all = $s && $s->{result}{n_ready} == 200;
            sleep .1 if !$all;
        }
        push @open_s, $all ? now() - $r->{rigd_began} : 999;
        end(delete $r->{rigd}) if $turn < 3;
    }
    printf "200 cameras open in %s s\n", join ', ', map { sprintf '%.1f', $_ } @open_s;
    promise(median(@open_s) <= 10, sprintf 'open 200 cameras in <= 10 s: median %.1f s', median(@open_s));
    $r->{conversation} = undef; # nobody watches
    sleep 3;
    my @w = workers($r);
    my ($daemon, $all, $sim, $begin) = (cpu_s($r->{rigd}), sum(map { cpu_s($_) } @w), cpu_s($r->{sim}), now());
    sleep 60; # two heartbeats
    my $s = now() - $begin;
    my ($rigd_pc, $workers_pc, $sim_pc) = map { 100 * $_ / $s } cpu_s($r->{rigd}) - $daemon, sum(map { cpu_s($_) } @w) - $all, cpu_s($r->{sim}) - $sim;
    promise($rigd_pc + $workers_pc <= 10, sprintf 'idle CPU <= 10%% of a core: %.2f%%: rigd %.2f%% + %d workers %.2f%% over %.0f s (rigsim %.2f%%)', $rigd_pc + $workers_pc, $rigd_pc, scalar @w, $workers_pc, $s, $sim_pc);
    my @kb = map { private_kb($_) } @w;
    promise(max(@kb) <= 4096, sprintf '<= 4 MB private memory per worker: median %d kB, most %d kB of %d; rigd %d kB', median(@kb), max(@kb), scalar @kb, private_kb($r->{rigd}));
    stop($r);

    $r = new_rig(cameras => 85, raw => '2448x1632', rig => "raw_mb = 9\nfree_space_mb = 100\n");
    start_rigd($r);
    ready($r) or die "85 cameras do not come up\n";
    my (@take_s, @cp_s, @collect_s, @thumbs_s, @sim_cpu_s, @rig_cpu_s, $bytes);
    for my $turn (0 .. 3) { # the first warms up
        system('sync');
        my @pids = ([$r->{sim}], [$r->{rigd}, workers($r)]);
        my @before = map { sum(map { cpu_s($_) } @$_) } @pids;
        my $t = now();
        my $a = capture($r, name => "scale$turn");
        my $take_s = now() - $t;
        my @used = map { sum(map { cpu_s($_) } @{$pids[$_]}) - $before[$_] } 0, 1;
        die "take failed: $a->{result}{reason}\n" if !$a->{ok} || $a->{result}{state} ne 'verified';
        $bytes = $a->{result}{bytes};
        my $id = $a->{result}{id};
        my $account = report($r, $id);
        my $collect_s = 1e-3 * max(map { $_->{files}[0]{copied_ms} } @{$account->{cameras}});
        my %stage = map { ($_->{stage} => $_) } @{$account->{time_line}};
        my $thumbs_s = $stage{thumbnails}{ended_s};
        system('sync');
        $t = now();
        system("cp -r $r->{takes}/$id/raw $r->{dir}/copy && sync") && die;
        my $cp_s = now() - $t;
        system('rm', '-rf', "$r->{dir}/copy", "$r->{takes}/$id");
        next if !$turn;
        push @take_s, $take_s; push @cp_s, $cp_s; push @collect_s, $collect_s; push @thumbs_s, $thumbs_s; push @sim_cpu_s, $used[0]; push @rig_cpu_s, $used[1];
    }
    printf "85 cameras, %.0f MB: button to verified %s s; shot to last frame safe %s s; cp + sync %s s\n", 1e-6 * $bytes, map { join ' ', map { sprintf '%.2f', $_ } @$_ } \@take_s, \@collect_s, \@cp_s;
    printf "medians: take %.2f s = %.0f MB/s (from the shot: %.2f s = %.0f MB/s), cp + sync %.2f s = %.0f MB/s\n", map { ($_, 1e-6 * $bytes / $_) } map { median(@$_) } \@take_s, \@collect_s, \@cp_s;
    printf "all %d thumbnails there, after the button: %s s; median %.2f s\n", 85, join(' ', map { sprintf '%.2f', $_ } @thumbs_s), median(@thumbs_s);
    printf "processor of a take: rigsim, which makes the pixels, %.2f s, rigd with its workers %.2f s\n", median(@sim_cpu_s), median(@rig_cpu_s);
    @kb = map { private_kb($_) } workers($r);
    printf "private memory of workers after 4 takes: median %d kB, most %d kB\n", median(@kb), max(@kb);
    stop($r);
}

# ---- faults --------------------------------------------------------------------------------------------------------------------

# name, what the script says of A06 (or a signal for its worker), when: after shot 3 (its collection suffers) or before it
my @faults = (
    ['busy 3 s', 'busy 3s'], ['busy for good', 'busy 40s'],
    ['event flood', 'flood 200 10s'], ['CaptureComplete lost', 'lose_complete 1'], ['ObjectAdded lost', 'lose_added 1'], ['events 3 s late', 'late 3s 2'],
    ['stall 3 s', 'stall 3s'], ['stall for good', 'stall 60s'],
    ['link drops', 'drop'], ['gone for 4 s', 'refuse 4s'], ['gone for 60 s', 'refuse 60s'], ['power cut 5 s', 'power_cut 5s'],
    ['file cut short', 'short 1'], ['file corrupt', 'corrupt 1'], ['slow link', 'slow 300000'],
    ['hostile: cut', 'hostile cut 3'], ['hostile: huge', 'hostile huge 3'], ['hostile: garbage', 'hostile garbage 3'], ['hostile: count', 'hostile count 3'],
    ['driver crash', 'SEGV'], ['driver hangs', 'STOP'],
    ['card full', 'card_full', 1], ['battery low', 'battery 5', 1], ['battery flat', 'battery 0', 1], ['setting not accepted', 'dial 0x5007 560 + drift 0x5007 560', 1], ['dial turned', 'dial 0x5007 560', 1],
    ['RAW+JPEG chosen', 'dial 0x5004 7', 1], ['another body', 'SERIAL', 1],
);

# One pair: a clean take and one with the fault. -> outcome, seconds, delays of the others, what the operator read
sub fault_pair {
    my ($fault) = @_;
    my ($name, $what, $before) = @$fault;
    my $signal = $what =~ /^(SEGV|STOP)$/;
    my $victim = 'A06';
    my $r = new_rig(ram => 1, cameras => 12, raw => '816x544', faults => $signal || $what eq 'SERIAL' ? undef : join('', map { sprintf "%s on shot %d %s\n", $victim, $before ? 2 : 3, $_ } split / \+ /, $what),
        trigger => "half_press_ms = 100\nhold_ms = 100", sections => $what eq 'SERIAL' ? sub { ${$_[0]} =~ s/serial = 6001006/serial = 6009999/ } : undef);
    start_rigd($r);
    $r->{cameras} = 11 if $what eq 'SERIAL';
    ready($r) or return;
    $r->{cameras} = 12;
    my $took = sub { my ($id) = @_; map { $_->{camera} => $_->{files}[0]{copied_ms} } grep { @{$_->{files}} } @{report($r, $id)->{cameras}} };
    my @clean;
    if ($what ne 'SERIAL') {
        capture($r, name => 'warm');
        my $a = capture($r, name => 'clean');
        @clean = $took->($a->{result}{id});
    } else { # the same rig without the stranger's slot being asked for
        capture($r, name => 'warm', without_missing => JSON::PP::true);
        @clean = $took->(capture($r, name => 'clean', without_missing => JSON::PP::true)->{result}{id});
    }
    my %clean = @clean;
    my $since = $what eq 'SERIAL' ? 0 : @{$r->{events}};
    my ($t0, $worker);
    if ($signal) {
        ($worker) = grep { (slurp("/proc/$_/cmdline") // '') =~ /$victim/ } workers($r);
        $r->{heard} = sub { if (!$t0 && $_[0]{event} eq 'state' && $_[0]{body}{state} eq 'collecting') { kill $what, $worker; $t0 = now() } };
    }
    my $asked = now();
    my $a = capture($r, name => 'fault', without_missing => $before ? JSON::PP::true : JSON::PP::false);
    my $answered = now();
    my @events = @{$r->{events}}[$since .. $#{$r->{events}}];
    if ($before) { $t0 = $what eq 'SERIAL' ? $r->{rigd_began} : $asked }
    $t0 //= (map { $_->{at} - .1 } grep { $_->{event} eq 'state' && $_->{body}{state} eq 'collecting' } @events)[0] // $asked;
    my $t = $a->{result};
    my %with = $took->($t->{id});
    my @delays = map { $with{$_} - $clean{$_} } grep { $_ ne $victim && defined $with{$_} && defined $clean{$_} } keys %clean;
    my @others = grep { $_ ne $victim } keys %with;
    my @told = grep { $_->{event} eq 'say' && ($_->{body}{camera} // '') eq $victim } @events;
    my ($quarantine) = grep { $_->{body}{text} =~ /quarantined/ } @told;
    my ($text) = map { $_->{body}{text} } grep { $_->{body}{severity} ne 'info' && $_->{body}{text} !~ /its shutter opened more/ } reverse @told;
    my ($out) = grep { $_->{camera} eq $victim } @{$t->{left_out} // []}, @{$t->{missing} // []};
    $text //= "camera $out->{camera} ($out->{port}): $out->{note}" if $out;
    my ($outcome, $s) = $quarantine ? ('quarantined', $quarantine->{at} - $t0) : $out ? ($before ? 'left out' : 'reported', $answered - $t0) : defined $with{$victim} ? ('delivered', $answered - $t0) : ('?', $answered - $t0);
    $outcome .= ", others $t->{state}" if $before && $out && $t->{state} ne 'verified';
    kill 'KILL', $worker if $signal;
    stop($r);
    system('rm', '-rf', $r->{dir});
    return { outcome => $outcome, s => $s, delay => median(@delays), last => max(map { $with{$_} } @others) - max(map { $clean{$_} } grep { $_ ne $victim } keys %clean), others => scalar @others, text => $text };
}

sub faults {
    my $pairs = shift // 3;
    my $which = shift // '.';
    my ($slow, $delayed, $silent) = (0, 0, 0);
    printf "%-22s %-12s %8s  %22s\n", 'fault of one of 12', 'outcome', 'after s', "others' delay ms (last)";
    for my $f (grep { $_->[0] =~ /$which/ } @faults) {
        my @p = map { fault_pair($f) // () } 1 .. $pairs;
        if (@p < $pairs) { promise(0, "$f->[0]: the rig did not come up"); next }
        my ($delay, $last, $s) = (median(map { $_->{delay} } @p), median(map { $_->{last} } @p), max(map { $_->{s} } @p));
        my %outcomes = map { $_->{outcome} => 1 } @p;
        my $outcome = join ' / ', sort keys %outcomes;
        my ($text) = map { $_->{text} // () } @p;
        printf "%-22s %-12s %8.1f  %10.0f (%.0f)   [%s]\n", $f->[0], $outcome, $s, $delay, $last, join ' ', map { sprintf '%.0f', $_->{delay} } @p;
        printf "    %s\n", $text if $text;
        $slow++ if $s > 15;
        $delayed++ if $delay >= 50;
        my $lost = $outcome !~ /^delivered$/;
        $silent++ if $lost && ($text // '') !~ /A06 \(ptpip:[^)]*\).*(check|set|put|empty|change|charge|compare|insert|free|resume|reinstate)/;
        promise(0, "$f->[0]: the others did not all deliver") if grep { $_->{others} != 11 } @p;
    }
    promise(!$slow, 'every fault: recovered or quarantined within 15 s');
    promise(!$delayed, 'every fault: the others are delayed by less than 50 ms');
    promise(!$silent, 'every camera that is out: slot and remedy are told');
}

# ---- soak ----------------------------------------------------------------------------------------------------------------------

sub soak {
    my $n = shift // 200;
    # Frames are deleted from the cards: libgphoto2 remembers each file on a card, and memory would grow with those.
    my $r = new_rig(ram => 1, cameras => 8, trigger => "half_press_ms = 60\nhold_ms = 100", rig => "raw_mb = 1\nfree_space_mb = 1\ndelete_after_verify = yes\n");
    start_rigd($r);
    ready($r) or die "does not come up\n";
    my $fds = sub { my ($pid) = @_; my @f = glob "/proc/$pid/fd/*"; scalar @f };
    my (%first, %last, @s);
    printf "%6s %9s %9s %12s %12s %12s %12s\n", 'take', 'rigd fds', 'worker fds', 'rigd kB', 'workers kB', 'processes', 'rigsim kB';
    for my $k (1 .. $n) {
        my $t = now();
        my $a = capture($r, name => "soak$k");
        push @s, now() - $t;
        promise(0, "take $k: $a->{result}{reason}") if ($a->{result}{state} // '') ne 'verified';
        $r->{events} = [];
        next if $k != int($n / 10) && $k != int($n / 2) && $k != $n;
        sleep .5;
        my @w = workers($r);
        my %now = (fds => $fds->($r->{rigd}), worker_fds => sum(map { $fds->($_) } @w), kb => private_kb($r->{rigd}), worker_kb => sum(map { private_kb($_) } @w), processes => 1 + @w);
        printf "%6d %9d %9d %12d %12d %12d %12d\n", $k, @now{qw(fds worker_fds kb worker_kb processes)}, private_kb($r->{sim});
        %first = %now if !%first;
        %last = %now;
    }
    printf "a take: median %.2f s, slowest %.2f s\n", median(@s), max(@s);
    promise($last{fds} == $first{fds} && $last{worker_fds} == $first{worker_fds}, "$n takes: no descriptor more");
    promise($last{processes} == $first{processes}, "$n takes: no process more");
    promise($last{kb} - $first{kb} <= 128 && $last{worker_kb} - $first{worker_kb} <= 8 * 64, sprintf '%d takes: memory does not grow: rigd %+d kB, 8 workers %+d kB', $n, $last{kb} - $first{kb}, $last{worker_kb} - $first{worker_kb});
    stop($r);
}

# ---- lag -----------------------------------------------------------------------------------------------------------------------

# What the wires of these bodies do without jitter: another rigsim of the same seed, pressed by hand.
sub true_lag_ms {
    my ($r) = @_;
    my $dir = folder();
    my @command = map { $_ eq "$r->{dir}/wires" ? "$dir/wires" : /^lag_jitter_ms/ ? 'lag_jitter_ms=0' : $_ } @{$r->{sim_command}};
    for (0 .. $#command) { $command[$_ + 1] = $r->{port} + 500 if $command[$_] eq '--port' }
    my $sim = { dir => $dir, sim_command => \@command };
    start_sim($sim);
    socket(my $s, AF_UNIX, 5, 0) or die "socket: $!"; # SOCK_SEQPACKET
    connect($s, pack_sockaddr_un("$dir/wires")) or die "wires: $!";
    my $change = sub { my ($line, $level, $at) = @_; send($s, pack('SCCLQqqqLL', 1, $line, $level, 0xffffffff, 7, int(1e9 * $at), 0, 0, 0, 0), 0) // die };
    my $at = now() + .6;
    $change->(1, 1, $at - .5); # half-press wakes them
    $change->(2, 1, $at);
    $change->(2, 0, $at + .2);
    $change->(1, 0, $at + .2);
    my @lag;
    while (grep({ defined } @lag) < $r->{cameras}) {
        recv($s, my $packet, 65536, 0);
        for (my $o = 0; $o + 48 <= length $packet; $o += 48) {
            my ($kind, undef, undef, $channel, undef, undef, undef, $lag_ns) = unpack 'SCCLQqqqLL', substr $packet, $o, 48;
            $lag[$channel] = 1e-6 * $lag_ns if $kind == 2;
        }
    }
    end($sim->{sim});
    return @lag;
}

# How far a body opened from the mean of its shot, on average.
sub misalignment_ms {
    my ($take) = @_;
    my @opened_ms = map { 1e-3 * $_->{delay_us} + $_->{lag_ms} } grep { defined $_->{lag_ms} } @{$take->{cameras}};
    my $mean = sum(@opened_ms) / @opened_ms;
    return sum(map { abs($_ - $mean) } @opened_ms) / @opened_ms;
}

sub lag {
    my ($worst, $skew, @misaligned_ms) = (0, 0);
    my $shots_wanted = shift // 60;
    for my $case ([117, 3, 0], [97, 7, 1], [107, 20, 2]) {
        my ($mean, $spread, $seed) = @$case;
        my $r = new_rig(cameras => 8, seed => $SEED + $seed, set => ["lag_ms=$mean", "lag_spread_ms=$spread", 'lag_jitter_ms=.25'], trigger => "half_press_ms = 60\nhold_ms = 100");
        my @true = true_lag_ms($r);
        start_rigd($r);
        ready($r) or die "does not come up\n";
        my $shots = sub { map { my $t = capture($r)->{result}; [$t->{spread_ms}, $t->{sigma_ms}, misalignment_ms(report($r, $t->{id}))] } 1 .. 5 };
        my @before = $shots->();
        my $t = now();
        my $a = request($r, 'calibrate', what => 'lag', shots => $shots_wanted, patience => 300);
        my $calibrated_s = now() - $t;
        my @after = $shots->();
        my @lag = @{$a->{result}{lag}};
        my @error = map { $lag[$_]{mean_ms} - $true[$_] } 0 .. $#lag;
        my $most = max(map { abs } @error);
        $worst = max($worst, $most);
        my ($sb, $gb, $sa, $ga) = map { my ($set, $i) = @$_; median(map { $_->[$i] } @$set) } [\@before, 0], [\@before, 1], [\@after, 0], [\@after, 1];
        $skew = max($skew, $ga);
        printf "lag %d +- %d ms, jitter .25 ms, 8 bodies, n = %d..%d, %.0f s: error of the mean %s, most %.3f ms; it says +- %.3f ms\n", $mean, $spread, min(map { $_->{n} } @lag), max(map { $_->{n} } @lag),
            $calibrated_s, join(' ', map { sprintf '%+.3f', $_ } @error), $most, max(map { $_->{error_ms} } @lag);
        printf "    spread of a shot: %.2f ms before, %.2f ms after; sigma %.2f, %.2f ms (medians of 5)\n", $sb, $sa, $gb, $ga;
        push @misaligned_ms, sum(map { $_->[2] } @after) / @after;
        stop($r);
    }
    promise($worst <= .1, sprintf 'lag: mean to +-.1 ms with n >= 30: %.3f ms (of a jitter of .25 ms, %d shots leave a sigma of %.3f ms by themselves)', $worst, $shots_wanted, .25 / sqrt $shots_wanted);
    promise(max(@misaligned_ms) <= .25, sprintf 'after calibration a body opens on average <= .25 ms off the mean of its shot: most %.3f ms of %d rigs', max(@misaligned_ms), scalar @misaligned_ms);
    promise($skew <= .25 * 1.5, sprintf 'after calibration only the bodies\' jitter (.25 ms) is left: sigma %.2f ms', $skew);
}

# ---- a hundred bodies ------------------------------------------------------------------------------------------------------------

sub preflight_s { # and what it found
    my ($r) = @_;
    my $t = now();
    my $a = request($r, 'preflight') // die "rigd left\n";
    return (now() - $t, $a->{result});
}

sub hundred {
    my $r = new_rig(ram => 1, cameras => 100, trigger => "half_press_ms = 60\nhold_ms = 100", set => ['lag_ms=117', 'lag_spread_ms=3', 'lag_jitter_ms=.25']);
    start_rigd($r);
    ready($r) or die "100 cameras do not come up\n";
    my @s;
    for (1 .. 3) {
        my ($s, $found) = preflight_s($r);
        promise(0, 'preflight finds the rig unfit: ' . encode_json($found->{findings}[0])) if !$found->{fit};
        push @s, $s;
    }
    promise(max(@s) <= 3, sprintf 'preflight of 100 bodies that are as they should be, in <= 3 s: most %.2f s, median %.2f s', max(@s), median(@s));

    my (@status_ms, @identify_ms);
    for my $k (1 .. 50) {
        my $t = now();
        request($r, 'status');
        push @status_ms, 1e3 * (now() - $t);
    }
    my $camera = request($r, 'status')->{result}{cameras}[41]{name};
    for (1 .. 5) {
        my $t = now();
        my $a = request($r, 'identify', camera => $camera);
        push @identify_ms, 1e3 * (now() - $t);
        promise(0, "identify $camera: $a->{error}{text}") if !$a->{ok};
    }
    promise(max(@status_ms) <= 200, sprintf 'the state of 100 cameras in <= 200 ms: median %.1f ms, most %.1f ms', median(@status_ms), max(@status_ms));
    promise(max(@identify_ms) <= 10000, sprintf 'identify tells its camera in <= 10 s: most %.0f ms', max(@identify_ms));

    my $t = now();
    my $a = request($r, 'calibrate', what => 'lag', shots => 32, patience => 500);
    my $s = now() - $t;
    my @lag = @{$a->{result}{lag} // []};
    promise(@lag == 100 && $s <= 300, sprintf 'lag of %d bodies in <= 300 s: %.0f s, n = %d..%d', scalar @lag, $s, min(map { $_->{n} } @lag), max(map { $_->{n} } @lag));
    my $shot = capture($r)->{result};
    promise(defined $shot->{spread_ms} && defined $shot->{sigma_ms}, sprintf 'a shot reports its spread and sigma: %.2f ms, %.2f ms', $shot->{spread_ms} // -1, $shot->{sigma_ms} // -1);

    # The same bodies are told something else: every setting of theirs that can be changed.
    end(delete $r->{rigd});
    my %other = (iso => '400', aperture => '11', shutter => '1/60', whitebalance => 'tungsten');
    my $config = slurp("$r->{dir}/rigd.conf");
    $config =~ s/^\Q$_\E = .*\n//m for keys %other;
    $config =~ s/^\[settings\]\n/"[settings]\n" . join '', map { "$_ = $other{$_}\n" } sort keys %other/me;
    open(my $c, '>', "$r->{dir}/rigd.conf") or die;
    print $c $config;
    close $c;
    start_rigd($r);
    ready($r) or die "100 cameras do not come up again\n";
    my ($told_s, $found) = preflight_s($r);
    print "    $_->{severity} $_->{camera}: $_->{text}\n" for @{$found->{findings}}[0 .. min(2, $#{$found->{findings}})];
    promise($found->{fit} && $told_s <= 2, sprintf '%d settings of 100 bodies in <= 2 s, read back, preflight included: %.2f s', scalar keys %other, $told_s);
    stop($r);

    links($_, 2e6) for 8, 16;
}

# Every camera's link carries so many bytes a second.
sub links {
    my ($n, $rate) = @_;
    my $r = new_rig(ram => 1, cameras => $n, raw => '2448x1632', rig => "raw_mb = 9\nfree_space_mb = 100\nfetch_limit = $n\n", faults => "* at 0s slow $rate\n");
    start_rigd($r);
    ready($r) or die "$n cameras do not come up\n";
    capture($r, name => 'warm');
    my $shot = capture($r, name => 'links')->{result};
    my $copied_s = max(map { 1e-3 * ($_->{copied_ms} // 0) } map { @{$_->{files}} } @{report($r, $shot->{id})->{cameras}});
    my $ideal_s = $shot->{bytes} / ($n * $rate);
    my $cpu_s = cpu_s($r->{sim}) + sum(map { cpu_s($_) } $r->{rigd}, workers($r));
    promise($ideal_s >= .85 * $copied_s, sprintf 'links of %d x %.0f MB/s used to >= 85 %%: %.1f %% (all safe %.2f s after the shot, names, thumbnails and checks included; the bytes alone need %.2f s; processor of everything so far %.1f s)',
        $n, 1e-6 * $rate, 100 * $ideal_s / $copied_s, $copied_s, $ideal_s, $cpu_s);
    stop($r);
}

# ---- full and failing disks ------------------------------------------------------------------------------------------------------

# Every file under its final name is whole: a TIFF that LibRaw's size agrees with is not asked for, only the size that all share.
sub partial_frames {
    my ($r) = @_;
    my @sizes = map { -s $_ // 0 } grep { !/\.part/ } glob "$r->{takes}/*/raw/*";
    my $whole = max(0, @sizes);
    scalar grep { $_ < $whole - 4096 } @sizes;
}

sub full {
    my $cameras = 8;
    my $takes = folder();
    system("mount -t tmpfs -o size=40m none $takes") == 0 or die "cannot mount a tmpfs: this needs root\n";
    my $unmounted = 0;
    my $ok = eval {
        for my $kind ('ENOSPC, space again after 3 s', 'ENOSPC, until the take gives up') {
            my $r = new_rig(cameras => $cameras, raw => '816x544', takes => "$takes/t", trigger => "half_press_ms = 60\nhold_ms = 100", faults => "A* at 0s slow 800000\n");
            start_rigd($r);
            ready($r) or die "does not come up\n";
            my ($filled, $partial) = (0, 0);
            $r->{heard} = sub {
                my ($m) = @_;
                return if $filled || $m->{event} ne 'state' || $m->{body}{state} ne 'collecting';
                sleep .6; # some are copied by halves
                open(my $f, '>', "$takes/filler") or die;
                while (defined syswrite($f, "\0" x 65536)) { }
                while (defined syswrite($f, "\0" x 512)) { }
                $filled = 1;
            };
            my $id = do { listen_for($r, 20, sub { $r->{conversation} }); ask($r, 'capture', name => 'full') };
            my $t = now();
            my $freed = 0;
            while (!$r->{answers}{$id} && now() - $t < 90) {
                listen_for($r, .1);
                $partial += partial_frames($r);
                if ($filled && !$freed && $kind =~ /3 s/ && now() - $t > 5) { unlink "$takes/filler"; $freed = now() }
            }
            my $a = $r->{answers}{$id};
            my $first = $a->{result}{state} // $a->{error}{text};
            my $answer_s = now() - $t;
            unlink "$takes/filler";
            my $again = $first eq 'verified' ? $a : request($r, 'resume', take => $a->{result}{id});
            my ($said) = map { $_->{body}{text} } grep { $_->{event} eq 'say' && $_->{body}{severity} ne 'info' && $_->{body}{text} =~ /space/ } @{$r->{events}};
            printf "%s: %s after %.1f s%s; then %s\n    %s\n", $kind, $first, $answer_s, $first eq 'failed' ? " ($a->{result}{reason})" : '', $again->{result}{state} // $again->{error}{text}, $said // '(nothing was said)';
            my $whole = $again->{ok} && request($r, 'export', take => $again->{result}{id})->{result}{intact};
            promise($filled && !$partial && ($again->{result}{state} // '') eq 'verified' && $again->{result}{n_frames} == $cameras && $whole && !`find $takes/t -name '*.part*'`, "$kind: nothing partial, all $cameras frames in the end, manifest intact");
            stop($r);
            system("rm -rf $takes/t");
        }
        1;
    };
    print "full: $@" if !$ok;
    $broken ||= !$ok;
    end($_, 'KILL') for keys %children;
    system('umount', $takes);
}

sub eio {
    my $cameras = 8;
    my $dir = folder(1);
    system($ENV{CC} // 'cc', '-shared', '-fPIC', '-O', '-o', "$dir/failing_disk.so", 'tests/bench/failing_disk.c', '-ldl') == 0 or die;
    for my $after_ms (0, 300) {
        my $r = new_rig(ram => 1, cameras => $cameras, faults => "A* at 0s slow 400000\n", trigger => "half_press_ms = 60\nhold_ms = 100", env => { LD_PRELOAD => "$dir/failing_disk.so", DISK_FAILS => "$dir/fails" });
        start_rigd($r);
        ready($r) or die "does not come up\n";
        my ($at, $partial, $failing) = (undef, 0, 0);
        $r->{heard} = sub { my ($m) = @_; $at = now() + 1e-3 * $after_ms if $m->{event} eq 'state' && $m->{body}{state} eq 'collecting' && !$at };
        listen_for($r, 20, sub { $r->{conversation} });
        my $id = ask($r, 'capture', name => 'eio');
        my $t = now();
        while (!$r->{answers}{$id} && now() - $t < 90) {
            listen_for($r, .005);
            if ($at && now() >= $at && !$failing) { open(my $f, '>', "$dir/fails"); $failing = 1 }
            $partial += partial_frames($r);
        }
        my $a = $r->{answers}{$id};
        my $answer_s = now() - $t;
        unlink "$dir/fails";
        my $first = $a->{result}{state};
        my $again = $first eq 'verified' ? $a : request($r, 'resume', take => $a->{result}{id});
        my $whole = $again->{ok} && request($r, 'export', take => $again->{result}{id})->{result}{intact};
        printf "EIO %d ms after the shots are collected: %s after %.1f s%s\n", $after_ms, $first, $answer_s, $first eq 'failed' ? " ($a->{result}{reason})" : '';
        print "    partial $partial, frames $again->{result}{n_frames}, manifest ", $whole ? 'intact' : 'not intact', "\n";
        promise(!$partial && ($again->{result}{state} // '') eq 'verified' && $again->{result}{n_frames} == $cameras && $whole && !`find $r->{takes} -name '*.part*'`, "EIO after $after_ms ms: nothing partial, then all $cameras frames, manifest intact");
        stop($r);
    }
}

my %commands = (kills => \&kills, scale => \&scale, faults => \&faults, soak => \&soak, lag => \&lag, hundred => \&hundred, full => \&full, eio => \&eio);
my $what = shift // '';
$SIG{INT} = $SIG{TERM} = sub { exit 2 };
my $main = $$;
END { if ($$ == ($main // 0)) { my $s = $?; kill 'KILL', keys %children; waitpid $_, 0 for keys %children; $? = $s } }
if (!$commands{$what}) {
    open(my $f, '<', $0);
    while (<$f>) { next if $. == 1; last if !/^#/; print s/^# ?//r }
    exit 2;
}
$commands{$what}->(@ARGV);
exit $broken;
